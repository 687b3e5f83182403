"""The sim-to-real gap: where it lies, which effect causes it, how far it shrinks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
