"""Results on disk: one JSON line for each (machine, setting) of a piece; what is there is not computed again."""

from __future__ import annotations

import functools
import json
import subprocess
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
#: Kept with the page that is made of them.
FOLDER = Path(__file__).with_name("measured")


class Results:
    """The lines of one piece, in `folder`/`piece`.jsonl. A last line cut off by a kill is ignored."""

    def __init__(self, folder: Path, piece: str):
        self._path = folder / f"{piece}.jsonl"
        self._lines: dict[tuple[int, str], dict[str, Any]] = {}
        text = self._path.read_text(encoding="utf-8") if self._path.exists() else ""
        for line in text.splitlines():
            try:
                entry = json.loads(line)
            except ValueError:
                continue
            self._lines[entry["machine"], entry["setting"]] = entry
        self._torn = bool(text) and not text.endswith("\n")

    def __len__(self) -> int:
        return len(self._lines)

    def get(self, machine: int, setting: str) -> Any:
        """The values kept for it, None where there are none."""
        entry = self._lines.get((machine, setting))
        return None if entry is None else entry["values"]

    def keep(self, machine: int, setting: str, values: Any, seconds: float) -> None:
        """Append a line that took `seconds` of CPU."""
        entry = {"machine": machine, "setting": setting, "commit": commit(), "seconds": round(seconds, 2)}
        entry["values"] = values
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write("\n" * self._torn + json.dumps(entry, separators=(",", ":")) + "\n")
        self._torn = False
        self._lines[machine, setting] = entry

    def of(self, setting: str) -> dict[int, Any]:
        """By machine: the values of one setting."""
        return {machine: e["values"] for (machine, name), e in sorted(self._lines.items()) if name == setting}

    @property
    def settings(self) -> list[str]:
        """Names in the order in which they came."""
        return list(dict.fromkeys(name for _, name in self._lines))

    @property
    def machines(self) -> set[int]:
        """Numbers of the machines."""
        return {machine for machine, _ in self._lines}

    @property
    def commits(self) -> list[str]:
        """Of the code that computed them."""
        return list(dict.fromkeys(entry["commit"] for entry in self._lines.values()))


@functools.cache
def commit() -> str:
    """Of the tree as this process found it, shortened; "unknown" outside a clone."""
    run = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    return run.stdout.strip() or "unknown"
