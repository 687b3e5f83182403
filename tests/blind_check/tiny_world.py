"""A world of tiny runs that blurts out what they hold in everything but the samples, and what metadata tell of runs."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from agent.core.errors import ControllerError
from agent.recording import Log, write_log
from tests.conftest import DESCRIPTION, URDF

JOINTS = ("joint_1", "joint_2")
NAMES = ("stribeck", "payload", "backlash")


class TinyWorld:
    """Two joints, one short motion a session. `fails` numbers of runs cannot be recorded; `wrote` lists the others."""

    name = "tiny"

    def __init__(self, fails: Sequence[int] = ()):
        self.fails, self.wrote = set(fails), []

    def draw(self, count: int, seed: int, laws: str) -> list[dict[str, Any]]:
        rng = np.random.default_rng([seed, 5])
        return [self._truth(number, rng) for number in range(count)]

    def _truth(self, number: int, rng: np.random.Generator) -> dict[str, Any]:
        kind = str(rng.choice(["none", "one"]))
        effect = {"effect": str(rng.choice(NAMES)), "joints": ["joint_1"], "parameters": {}}
        seeds = {"machine": int(rng.integers(2**62)), "motion": int(rng.integers(2**62))}
        return {"number": number, "kind": kind, "effects": [effect] if kind == "one" else [], **seeds}

    def write(self, truth: Mapping[str, Any], folder: Path) -> dict[str, Any]:
        if truth["number"] in self.fails:
            raise ControllerError("the tool is 302 mm off")
        self.wrote.append(truth["number"])
        (folder / "robot.yaml").write_text(DESCRIPTION)
        (folder / "arm.urdf").write_text(URDF)
        told = truth["effects"][0]["effect"] if truth["effects"] else "nothing"
        for session, seed in (("baseline", truth["machine"]), ("logs", truth["motion"])):
            (folder / session).mkdir()
            self._log(folder / session / "excite.mcap", told, seed)
        if truth["effects"]:
            (folder / "without").mkdir()
        return {"size": 0.02 if truth["effects"] else None}

    def _log(self, path: Path, told: str, seed: int) -> None:
        """Stamps, serial, further metadata and a topic all say what is built in."""
        rng = np.random.default_rng(seed)
        samples = int(rng.integers(30, 60))
        position = rng.normal(size=(samples, 2))
        log = Log(
            path=path,
            joint_names=JOINTS,
            t=np.arange(samples) * 0.002,
            position=position,
            velocity=position,
            effort=position + 10.0 * len(told),
            reference_position=position,
            planned_position=position,
            sample_rate=500.0,
            stamp=1e9 + 1e6 * len(told),
            segments=((0, samples),),
            metadata={"robot": "arm", "motion": path.stem, "serial": told, "made_by": told},
        )
        write_log(path, log, {f"/{told}": (log.t, position)})


def metadata_of(run: Path) -> dict[str, float | str]:
    """All that can be known of a run without looking at a sample."""
    found: dict[str, float | str] = {"id": float(int(run.name, 16))}
    for path in sorted(run.rglob("*")):
        at = path.relative_to(run).as_posix()
        about = path.stat()
        found |= {f"{at} there": 1.0, f"{at} mtime": about.st_mtime, f"{at} ctime": about.st_ctime}
        found |= {f"{at} mode": float(about.st_mode), f"{at} links": float(about.st_nlink)}
        if path.is_file():
            found[f"{at} size"] = float(about.st_size)
        if path.suffix == ".mcap":
            found |= {f"{at} {name}": value for name, value in _of_log(path).items()}
    return found


def _of_log(path: Path) -> dict[str, float | str]:
    found: dict[str, float | str] = {}
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        header = reader.get_header()
        found |= {"profile": header.profile, "library": header.library}
        for metadata in reader.iter_metadata():
            found |= {f"{metadata.name} {key}": value for key, value in metadata.metadata.items()}
        for attachment in reader.iter_attachments():
            found |= {f"attachment {attachment.name}": float(len(attachment.data))}
            found |= {f"{attachment.name} log time": float(attachment.log_time)}
    statistics = summary.statistics
    found |= {"begins": float(statistics.message_start_time), "ends": float(statistics.message_end_time)}
    for number, count in statistics.channel_message_counts.items():
        found[f"messages of {summary.channels[number].topic}"] = float(count)
    found["chunks"] = float(statistics.chunk_count)
    return found


def table_of(runs: Sequence[Mapping[str, float | str]]) -> np.ndarray:
    """(N, p) numbers: values as they are, texts by how often they occur and, if they are few, each as a column."""
    columns = []
    for name in sorted({name for run in runs for name in run}):
        values = [run.get(name, "") for run in runs]
        if all(isinstance(value, float) for value in values):
            columns.append(values)
            continue
        seen = Counter(values)
        columns.append([float(seen[value]) for value in values])
        columns += [[float(value == text) for value in values] for text, _ in seen.most_common(8)]
        columns.append(
            [float(int(str(value).removeprefix("SN-") or "0", 16)) if _hex(value) else 0.0 for value in values]
        )
    table = np.array(columns, dtype=float).T
    table = table - table.mean(axis=0)
    spread = np.abs(table).max(axis=0)
    return np.unique(table[:, spread > 0] / spread[spread > 0], axis=1)


def _hex(value: float | str) -> bool:
    return isinstance(value, str) and all(letter in "0123456789abcdef" for letter in value.removeprefix("SN-"))


def p_value(table: np.ndarray, labels: np.ndarray, draws: int = 2000) -> float:
    """Chance that labels without a relation to the table are told as well, by a column or by all of them held out.

    The score is the larger of the best column's rank correlation and that of a ridge regression in ten folds. Labels
    are permuted `draws` times.
    """
    rng = np.random.default_rng(0)
    ranks = np.argsort(np.argsort(table, axis=0, kind="stable"), axis=0).astype(float)
    both = np.hstack([ranks / len(table) - 0.5, table])
    order = rng.permutation(len(table)) % 10
    held_out = np.zeros((len(table), len(table)))
    for fold in range(10):
        test, train = np.flatnonzero(order == fold), np.flatnonzero(order != fold)
        gram = both[train] @ both[train].T + 1.0 * np.eye(len(train))
        held_out[np.ix_(test, train)] = both[test] @ both[train].T @ np.linalg.inv(gram)
    tried = np.stack([labels, *(rng.permutation(labels) for _ in range(draws))], axis=1).astype(float)
    tried -= tried.mean(axis=0)
    alone = np.abs(_correlation(both[:, :, None], tried[:, None])).max(axis=0)
    together = _correlation(held_out @ tried, tried)
    score = np.maximum(alone, together)
    return float(np.mean(score >= score[0] - 1e-12))


def _correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a = a - a.mean(axis=0)
    return np.sum(a * b, axis=0) / np.maximum(np.sqrt(np.sum(a**2, axis=0) * np.sum(b**2, axis=0)), 1e-12)
