"""The commands as steps: calibrate, recalibrate, diagnose, plan, check, and what they say."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
