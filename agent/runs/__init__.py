"""Run folders, their lock and history, trends, stored loops and current models."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
