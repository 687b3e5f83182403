"""The guard: what must hold before an arm moves and while it does, and the cell it moves in."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
