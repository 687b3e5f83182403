"""The key of a benchmark: what every run holds. It lies outside the runs and only its owner may read it."""

from __future__ import annotations

import hashlib
import json
import secrets
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from agent.core import AgentError, InputError, read_json, sha256_file, written_whole

#: Of the benchmark, and of what its runs, key and answers mean.
NAME, VERSION = "WEDGE", "1.0"
#: Kinds of runs: without an effect, with one, two or three of the catalogue, with one that it has no name for.
KINDS = ("none", "one", "two", "three", "outside")
_SCHEMA = "blind-key/1"


@dataclass(frozen=True)
class Key:
    """A draw and, once it is recorded, its runs.

    `salt` is drawn from the operating system and stands here only. All that is random about the runs is a digest of it
    and of `seed`: nobody can try seeds, and the key is all that is needed to draw the same runs again. `laws` are those
    of "judgement", or of "development" where somebody chose the seed; the two never share what is random.
    """

    world: str
    count: int
    seed: int
    salt: str
    runs: list[dict[str, Any]] = field(default_factory=list)
    not_recorded: list[dict[str, Any]] = field(default_factory=list)
    laws: str = "judgement"

    @classmethod
    def fresh(cls, world: str, count: int, seed: int | None) -> Key:
        """Of runs that are yet to be recorded; without a `seed` that comes from the operating system, too."""
        laws = "judgement" if seed is None else "development"
        return cls(world, count, secrets.randbits(32) if seed is None else seed, secrets.token_hex(16), laws=laws)

    @property
    def entropy(self) -> int:
        """Seed of everything that is drawn."""
        return int.from_bytes(hashlib.sha256(f"{self.salt} {self.laws} {self.seed}".encode()).digest())

    @classmethod
    def load(cls, path: Path, draw: tuple[str, int, int | None] | None = None) -> Key:
        """Read a key, which has to be of this `draw`: world, number of runs and, unless None, seed.

        Raises:
            InputError: it is missing, no key of this version, or of another draw.
        """
        data = read_json(path)
        if not isinstance(data, dict) or data.pop("schema", None) != _SCHEMA:
            raise InputError(f"{path}: not a key of a blind check (schema {_SCHEMA!r} is expected)")
        if (benchmark := data.pop("benchmark", None)) != f"{NAME} {VERSION}":
            raise InputError(f"{path}: a key of {benchmark}; this version scores {NAME} {VERSION}")
        try:
            key = cls(**data)
        except TypeError as error:
            raise InputError(f"{path}: not a whole key: {error}") from None
        if not isinstance(key.runs, list) or not all(map(_whole, key.runs)):
            raise InputError(f"{path}: not a whole key: a run lacks its id, kind, effects or size")
        if draw is not None and draw not in [(key.world, key.count, seed) for seed in (None, key.seed)]:
            raise InputError(
                f"{path}: is the key of {key.count} runs of world {key.world}, seed {key.seed}; repeat these options "
                "to continue or to draw them again, or name another folder and key"
            )
        return key

    def save(self, path: Path) -> str:
        """Write the key, readable by its owner only; returns its SHA-256.

        Raises:
            AgentError: it cannot be written.
        """
        data = {"schema": _SCHEMA, "benchmark": f"{NAME} {VERSION}", **asdict(self)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(path) as unfinished:
                unfinished.touch(0o600)
                unfinished.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        except OSError as error:
            raise AgentError(f"{path}: the key cannot be written: {error.strerror}; free space or rights?") from None
        return sha256_file(path)


def _whole(run: Any) -> bool:
    """Whether a run of a key can be scored."""
    if not isinstance(run, dict) or run.get("kind") not in KINDS or not {"run", "size"} <= run.keys():
        return False
    return all({"effect", "joints"} <= effect.keys() for effect in run.get("effects", ({},)))
