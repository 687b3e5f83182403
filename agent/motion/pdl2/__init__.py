"""PDL2, the language of COMAU's controllers: the motion subset, read, run and written.

What is exported here is a program as it was read, for another interpreter. The parser generator is imported only when
a program is read.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
