"""Simulators as files: MuJoCo's MJCF and URDF read as an identified model, corrected, exported and run forward.

Nothing in such a file was identified, so its parameters have no uncertainty. The model treats them as exact, and the
caller sets the model's error (docs/diagnosis.md).
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
