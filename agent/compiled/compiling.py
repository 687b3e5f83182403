"""How a function is compiled, and where the result is kept."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numba  # a third of a second

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(signature: str) -> Callable[[Function], Function]:
    """Compile for one signature, strictly as written: no fused or reordered arithmetic, so digits are NumPy's.

    The result is kept next to the module. If that fails, it goes to the user's cache, or else to a temporary
    folder of the user's own. Numba looks at the module's own text to see whether it is stale, so a compiled function
    may call those of its own module only.
    """

    cached: Callable[[Function], Function] = numba.njit(signature, cache=True)  # type: ignore[assignment]

    def compile_it(function: Function) -> Function:
        try:
            return cached(function)
        except (RuntimeError, OSError):  # no such folder, or the disk is full
            pass
        try:
            numba.config.CACHE_DIR = _own_folder()  # type: ignore[attr-defined]
            return cached(function)
        except (RuntimeError, OSError):
            once: Function = numba.njit(signature)(function)  # type: ignore[assignment]
            return once

    return compile_it


def _own_folder() -> str:
    """A temporary folder that only this user can write to, because files read from it are executed.

    Raises:
        OSError: there is none.
    """
    folder = Path(tempfile.gettempdir()) / f"calibration-agent-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise OSError(f"{folder} is not this user's alone")
    return str(folder)
