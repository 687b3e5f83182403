"""The commands over many robots: one task per robot and run, on local cores or a Dask scheduler."""

import lazy_loader

from agent.core import needed

for _package in ("fsspec", "pyarrow"):
    needed(_package, "a fleet")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
