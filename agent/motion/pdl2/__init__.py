"""PDL2, the language of COMAU's controllers: the motion subset, read, run and written.

The parser generator is imported only when a program is read.
"""
