"""The experiment that tells what a diagnosis leaves open: which motion, and what it is expected to say."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
