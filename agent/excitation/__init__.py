"""Excitation: the loop through the sub-region with the most information on the parameters."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
