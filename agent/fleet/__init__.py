"""The commands over many robots: one task per robot and run, on local cores or a Dask scheduler."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
