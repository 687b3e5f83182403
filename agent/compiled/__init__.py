"""Inner loops, compiled by Numba (docs/decisions/compiled.md): numbers in, numbers out.

To import a function loads Numba, which takes a third of a second: only what works out motions, of an arm or of a gear
with play, imports from here.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
