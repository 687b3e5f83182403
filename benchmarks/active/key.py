"""The key: what was built into every run, fixed by its hash before the first diagnosis."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from agent.core import InputError, sha256_text, write_atomically
from fake_controller.withheld.cases import Case

#: The hash, there from the start; and the key itself, there after the last diagnosis.
SEAL, KEY = "key.sha256", "key.json"


def key_text(seed: int, robot: str, cases: Sequence[Case]) -> str:
    """The whole key as text, the same for the same draw."""
    data = {"seed": seed, "robot": robot, "cases": [case.to_dict() for case in cases]}
    return json.dumps(data, indent=1, sort_keys=True) + "\n"


def seal(folder: Path, text: str) -> str:
    """Note the key's SHA-256 in a folder, where it is not noted yet; returns it.

    Raises:
        InputError: the folder is that of a check with another key.
    """
    digest = sha256_text(text)
    path = folder / SEAL
    if path.exists():
        if path.read_text(encoding="utf-8").split()[:1] != [digest]:
            raise InputError(
                f"{folder}: holds a blind check with another seed or number of cases, or of another version; name "
                "another folder with -o"
            )
    else:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise InputError(f"{folder}: is a file, or lies below one; name a folder with -o") from None
        write_atomically(path, f"{digest}  {KEY}\n")
    return digest


def open_key(folder: Path, text: str) -> None:
    """Write the key in clear; nothing is diagnosed any more."""
    write_atomically(folder / KEY, text)
