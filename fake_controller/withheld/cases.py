"""Which runs the emulator's world holds: drawn from a seed, over effects, joints, signs and sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from agent.model import CATALOGUE
from agent.robot import Dynamics, RobotDescription

#: Effects that the catalogue has no form for.
OUTSIDE = ("rough_bearing", "wandering_torque", "rubbing_brake")


@dataclass(frozen=True)
class Mix:
    """What is drawn: the share of each kind of run, lowest and highest strength, and the effects by name."""

    shares: Mapping[str, float]
    strengths: tuple[float, float]
    names: tuple[str, ...]


#: From a tenth of an effect's usual size, which is too small to matter, to twice the usual size.
USUAL = Mix({"none": 0.35, "one": 0.45, "two": 0.1, "outside": 0.1}, (0.1, 2.0), tuple(CATALOGUE))


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
    kinds = [str(kind) for kind in rng.permutation(_kinds(count, mix.shares))]
    names, outside = _Deck(mix.names, rng), _Deck(OUTSIDE, rng)
    cases = []
    for number, kind in enumerate(kinds):
        strength = float(np.exp(rng.uniform(*np.log(mix.strengths))))
        chosen = [(outside if kind == "outside" else names).draw() for _ in range({"none": 0, "two": 2}.get(kind, 1))]
        effects = tuple(draw_effect(name, robot, strength, rng) for name in chosen)
        while _collide(effects):
            effects = tuple(draw_effect(name, robot, strength, rng) for name in (chosen[0], names.draw()))
        machine, motion = (int(part) for part in rng.integers(2**62, size=2))
        cases.append(Case(number, kind, machine, motion, strength, effects))
    return cases


def _kinds(count: int, shares: Mapping[str, float]) -> list[str]:
    """Kinds of `count` runs by the largest remainder, so that even a dozen has some of each."""
    wanted = {kind: share * count for kind, share in shares.items()}
    counts = {kind: int(value) for kind, value in wanted.items()}
    rest = sorted(wanted, key=lambda kind: counts[kind] - wanted[kind])
    for kind in rest[: count - sum(counts.values())]:
        counts[kind] += 1
    return [kind for kind, times in counts.items() for _ in range(times)]


class _Deck:
    """Names in random order, each once before any comes again."""

    def __init__(self, names: tuple[str, ...], rng: np.random.Generator):
        self._names, self._rng = names, rng
        self._left: list[str] = []

    def draw(self) -> str:
        if not self._left:
            self._left = [str(name) for name in self._rng.permutation(self._names)]
        return self._left.pop()


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
    return {"effect": name, "joints": joints, "parameters": _plain(_parameters(name, robot, joint, strength, rng))}


def _parameters(name: str, robot: RobotDescription, k: int, s: float, rng: np.random.Generator) -> dict[str, Any]:
    """Parameters of an effect on joint k; at s = 1 a few percent of nominal torque (of 100 N·m without one)."""
    nominal, fastest = float(np.nan_to_num(robot.nominal_torque, nan=100.0)[k]), float(robot.max_velocity[k])
    sign, seed, draw = float(rng.choice([-1.0, 1.0])), float(rng.integers(1_000_000)), rng.uniform
    drawn: dict[str, Callable[[], dict[str, Any]]] = {  # only the ones that are asked for are drawn
        "stribeck": lambda: {"rise": 0.06 * s * nominal, "speed": draw(0.02, 0.08) * fastest},
        "asymmetric_friction": lambda: {
            "coulomb": sign * min(0.25 * s, 0.8),
            "viscous_fraction": sign * min(0.3 * s, 0.8),
        },
        "load_dependent_friction": lambda: {"coefficient": 0.12 * s},
        "viscous_nonlinearity": lambda: {"torque": 0.08 * s * nominal, "speed": draw(0.02, 0.06) * fastest},
        "thermal_friction": lambda: {
            "start": -25.0,
            "time_constant": draw(10, 60),
            "coulomb_rate": 0.012 * s,
            "viscous_rate": 0.02 * s,
        },
        "presliding": lambda: {"share": draw(0.6, 0.9), "travel": 0.02 * s},
        "friction_change": lambda: {
            "coulomb": 1 + sign * min(0.4 * s, 0.7),
            "viscous": 1 + sign * min(draw(0, 0.5) * s, 0.7),
        },
        "joint_elasticity": lambda: {"stiffness": _inertia(robot, k) * (2 * np.pi * draw(7, 11)) ** 2 / s},
        "backlash": lambda: {"gap": 0.002 * s},
        "torque_ripple": lambda: {
            "amplitude": 0.06 * s * nominal,
            "order": float(rng.choice([0.5, 1.0, 2.0])),
            "phase": draw(0, 6),
        },
        "wrist_coupling": lambda: {"factor": sign * 0.25 * s},
        "payload": lambda: {"mass": 3 * s, "centre": [*draw(-0.05, 0.05, 2), draw(0.02, 0.2)]},
        "gravity_spring": lambda: {
            "preload": 0.6 * s * nominal,
            "rate": draw(0, 1) * s * nominal,
            "angle": draw(-1, 1),
        },
        "dress_pack": lambda: {
            "stiffness": 0.05 * s * nominal,
            "centre": draw(-1, 1),
            "hysteresis": 0.02 * s * nominal,
        },
        "base_tilt": lambda: {"roll": sign * 0.02 * s, "pitch": draw(-0.02, 0.02) * s},
        "inertial_mismatch": lambda: {
            "link": float(rng.integers(2, max(robot.dof, 3))),  # a changed last link is a payload by another name
            "scale": 1 + sign * 0.2 * s,
            "points": [[4 * s, *draw(-0.3, 0.3, 3)]],
        },
        "contact": lambda: {
            "force": (way := rng.normal(size=3)) / np.linalg.norm(way) * 120 * s,
            "start": draw(5, 50),
            "duration": draw(0.5, 3),
        },
        "torque_constant": lambda: {"scale": 1 + sign * 0.1 * s},
        "torque_offset": lambda: {"offset": sign * 0.06 * s * nominal},
        "time_delay": lambda: {"delay": 0.006 * s},
        "encoder_offset": lambda: {"offset": sign * 0.02 * s},
        "interpolator_mismatch": lambda: {"rate": 1 + sign * 0.02 * s, "blend": draw(0, 0.08) * s},
        "rough_bearing": lambda: {"amplitude": 0.15 * s * nominal, "patch": draw(0.04, 0.15), "seed": seed},
        "wandering_torque": lambda: {
            "amplitude": 0.05 * s * nominal,
            "memory": float(np.exp(draw(np.log(0.2), np.log(2.0)))),
            "seed": seed,
        },
        "rubbing_brake": lambda: {"drag": 0.1 * s * nominal, "on": draw(0.2, 0.8), "off": draw(0.5, 2), "seed": seed},
    }
    return drawn[name]()


def _inertia(robot: RobotDescription, k: int) -> float:
    """[kg·m²] that joint k sees in the middle of its range."""
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    return float(Dynamics(robot).mass_matrix(0.5 * (lower + upper))[k, k])


def _plain(value: Any) -> Any:
    """Numbers and lists of numbers, as JSON has them."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(entry) for entry in value]
    return float(value)
