"""Which runs the emulator's world holds: drawn from a seed, over effects, joints, signs and sizes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.model import CATALOGUE
from agent.robot import RobotDescription
from fake_controller.actuation import EFFECTS, OUTSIDE
from fake_controller.actuation.effect import Drawn


@dataclass(frozen=True)
class Mix:
    """What is drawn: the share of each kind of run, lowest and highest strength, and the effects by name."""

    shares: Mapping[str, float]
    strengths: tuple[float, float]
    names: tuple[str, ...]


#: From a tenth of an effect's usual size, which is too small to matter, to twice the usual size.
USUAL = Mix({"none": 0.35, "one": 0.45, "two": 0.1, "outside": 0.1}, (0.1, 2.0), tuple(filter(EFFECTS.get, CATALOGUE)))


@dataclass(frozen=True)
class Case:
    """One run: `machine` and `motion` (of its programs) are seeds; `effects` as the fake controller takes them.

    `strength` multiplies the size that an effect of this kind usually has on a machine in need of repair.
    """

    number: int
    kind: str
    machine: int
    motion: int
    strength: float
    effects: tuple[dict[str, Any], ...]


def draw_cases(count: int, seed: int, robot: RobotDescription, mix: Mix = USUAL) -> list[Case]:
    """Draw `count` runs in random order; every effect of the mix comes up equally often.

    Seeds of machines and motions have 62 random bits each. Somebody who knew one could repeat the run without its
    effect, and these are too many to try.
    """
    rng = np.random.default_rng([seed, 77])
    kinds = [str(kind) for kind in rng.permutation(kinds_of(count, mix.shares))]
    names, outside = deck(mix.names, rng), deck(OUTSIDE, rng)
    cases = []
    for number, kind in enumerate(kinds):
        strength = float(np.exp(rng.uniform(*np.log(mix.strengths))))
        chosen = [next(outside if kind == "outside" else names) for _ in range({"none": 0, "two": 2}.get(kind, 1))]
        effects = tuple(draw_effect(name, robot, strength, rng) for name in chosen)
        while _collide(effects):
            effects = tuple(draw_effect(name, robot, strength, rng) for name in (chosen[0], next(names)))
        machine, motion = (int(part) for part in rng.integers(2**62, size=2))
        cases.append(Case(number, kind, machine, motion, strength, effects))
    return cases


def kinds_of(count: int, shares: Mapping[str, float]) -> list[str]:
    """Kinds of `count` runs by the largest remainder, so that even a dozen has some of each."""
    wanted = {kind: share * count for kind, share in shares.items()}
    counts = {kind: int(value) for kind, value in wanted.items()}
    by_remainder = sorted(wanted, key=lambda kind: counts[kind] - wanted[kind])
    for kind in by_remainder[: count - sum(counts.values())]:
        counts[kind] += 1
    return [kind for kind, times in counts.items() for _ in range(times)]


def deck(names: Iterable[str], rng: np.random.Generator) -> Iterator[str]:
    """Names in random order, each once before any comes again."""
    while True:
        yield from map(str, rng.permutation(list(names))[::-1])


def _collide(effects: tuple[dict[str, Any], ...]) -> bool:
    """Whether two effects are the same one, or two gears in one joint."""
    if len(effects) < 2:
        return False
    first, second = effects
    gears = all("twist" in CATALOGUE[effect["effect"]].shapes for effect in effects)
    return first["effect"] == second["effect"] or (gears and first["joints"] == second["joints"])


def draw_effect(name: str, robot: RobotDescription, strength: float, rng: np.random.Generator) -> dict[str, Any]:
    """Draw where and how an effect sits on the arm, `strength` times as large as usual."""
    n = robot.dof
    joint = int(rng.integers(n))
    whole = name in CATALOGUE and CATALOGUE[name].scope in ("arm", "base")
    joints = [] if whole else [robot.joint_names[joint]]
    if name == "wrist_coupling":
        first, second = sorted(rng.choice(range(max(0, n - 3), n), 2, replace=False))
        joints = [robot.joint_names[first], robot.joint_names[second]]
    drawn = (EFFECTS | OUTSIDE)[name].usual(Drawn(robot, joint, strength, rng))
    return {"effect": name, "joints": joints, "parameters": _plain(drawn)}


def _plain(value: Any) -> Any:
    """Numbers and lists of numbers, as JSON has them."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(entry) for entry in value]
    return float(value)
