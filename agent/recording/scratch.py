"""Arrays of long logs on disk instead of in memory.

They are memory-mapped temporary files without a name. A loop over `Scratch.each` or `Scratch.parts` holds one part of
them in memory at a time. Small arrays stay in memory, so a log of some minutes never touches the disk.
"""

from __future__ import annotations

import mmap
import os
import tempfile
from collections.abc import Iterable, Iterator
from typing import TypeVar

import numpy as np

_IN_MEMORY = 2**26  # bytes handed out before the disk is used
_EXTENT = 2**26  # bytes of a file
_ROWS = 2**15  # worked on at a time
_Item = TypeVar("_Item")


class Scratch:
    """Owner of arrays and of their memory. A full disk is an OSError of `empty` and `keep`, not a bus error later."""

    def __init__(self) -> None:
        self._memory_left = _IN_MEMORY
        self._extents: list[mmap.mmap] = []
        self._used = 0

    def empty(self, shape: tuple[int, ...]) -> np.ndarray:
        """An array of float64 whose values are to be written."""
        size = 8 * int(np.prod(shape))
        if size <= self._memory_left:
            self._memory_left -= size
            return np.empty(shape)
        if not self._extents or self._used + size > len(self._extents[-1]):
            self._extents.append(_extent(max(size, _EXTENT)))
            self._used = 0
        start, self._used = self._used, self._used + size
        return np.frombuffer(self._extents[-1], count=size // 8, offset=start).reshape(shape)

    def keep(self, values: np.ndarray) -> np.ndarray:
        """The same values, moved here; in the order of memory they had."""
        if values.nbytes <= self._memory_left:
            self._memory_left -= values.nbytes
            return values
        turned = values.ndim > 1 and values.flags.f_contiguous
        moved = self.empty(values.T.shape if turned else values.shape)
        moved[...] = values.T if turned else values
        self._release()
        return moved.T if turned else moved

    def each(self, items: Iterable[_Item]) -> Iterator[_Item]:
        """The items one after the other; after each, the memory of what lies on disk is given back.

        The values stay, and come again when they are looked at.
        """
        for item in items:
            try:
                yield item
            finally:  # also where whoever goes over them stops early
                self._release()

    def parts(self, size: int) -> Iterator[slice]:
        """`each` of the parts that `size` rows are cut into; a part is small compared with a long log."""
        return self.each(slice(first, min(first + _ROWS, size)) for first in range(0, size, _ROWS))

    def _release(self) -> None:
        for extent in self._extents:
            extent.madvise(mmap.MADV_DONTNEED)


def _extent(size: int) -> mmap.mmap:
    with tempfile.TemporaryFile() as file:
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
        except OSError as error:
            raise OSError(error.errno, error.strerror, tempfile.gettempdir()) from None
        return mmap.mmap(file.fileno(), size)
