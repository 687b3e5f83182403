"""Experiments that settle what a diagnosis leaves open: the next motion and its expected result."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
