"""The same over many robots: one task a robot and run, on the cores of this machine or a Dask scheduler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
