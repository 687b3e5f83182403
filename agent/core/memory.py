"""Memory that arrays take and give back, many times a second."""

from __future__ import annotations

#: Less than glibc's largest threshold (32 MiB), which it would not raise.
_BLOCK = 30_000_000


def keep_freed_memory() -> None:
    """Let the C library keep what arrays give back for the next ones, instead of returning it to the system each time.

    glibc maps blocks above a threshold and hands back free memory above twice that; freeing a mapped block raises the
    threshold to its size (mallopt(3), M_MMAP_THRESHOLD). One block that is never touched does it, and costs nothing.
    Without it a tenth of the time of a search goes into fetching the same pages again. Elsewhere it does nothing.
    """
    bytes(_BLOCK)
