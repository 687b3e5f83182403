"""Which runs there are: drawn from a seed over arms, joints, effects and sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from second_world.arms import Arm, draw_arm
from second_world.faults import OUTSIDE

#: Share of each kind; the rest has one effect.
SHARES = {"none": 0.25, "two": 0.1, "outside": 0.1}
_NAMES = (
    "payload",
    "friction_change",
    "stribeck",
    "asymmetric_friction",
    "viscous_nonlinearity",
    "load_dependent_friction",
    "presliding",
    "gravity_spring",
    "dress_pack",
    "base_tilt",
    "torque_constant",
    "torque_offset",
    "time_delay",
    "encoder_offset",
    "joint_elasticity",
    "backlash",
    "torque_ripple",
    "wrist_coupling",
    "contact",
    "thermal_friction",
    "inertial_mismatch",
)
_GEARS = ("joint_elasticity", "backlash")


def draw_cases(count: int, seed: int, mix: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """`count` runs in random order; effects come up equally often.

    `mix`: other `shares`, `strengths` (lowest, highest) and `names` of effects than usual.
    """
    mix = mix or {"shares": SHARES, "strengths": (0.6, 2.0), "names": _NAMES}
    rng = np.random.default_rng([seed, 78])
    others = {kind: share for kind, share in mix["shares"].items() if kind != "one"}
    kinds = [kind for kind, share in others.items() for _ in range(round(share * count))]
    kinds = [str(kind) for kind in rng.permutation([*kinds, *["one"] * (count - len(kinds))])]
    names, outside = _deck([name for name in _NAMES if name in mix["names"]], rng), _deck(OUTSIDE, rng)
    cases = []
    for number, kind in enumerate(kinds):
        machine, motion = (int(part) for part in rng.integers(2**62, size=2))  # too many to try
        arm = draw_arm(machine)
        strength = float(np.exp(rng.uniform(*np.log(mix["strengths"]))))
        if kind == "outside":
            chosen = [next(outside)]
        else:
            chosen = [next(names) for _ in range({"none": 0, "two": 2}.get(kind, 1))]
        while len(chosen) == 2 and (chosen[0] == chosen[1] or all(name in _GEARS for name in chosen)):
            chosen[1] = next(names)
        effects = [_draw_effect(name, arm, strength, rng) for name in chosen]
        # Two changes of one joint's friction are one change.
        while len(effects) == 2 and effects[0]["joints"] and effects[0]["joints"] == effects[1]["joints"]:
            effects[1] = _draw_effect(chosen[1], arm, strength, rng)
        cases.append(
            {
                "number": number,
                "kind": kind,
                "machine": machine,
                "motion": motion,
                "strength": strength,
                "effects": effects,
                "recorder": recorder(machine),
            }
        )
    return cases


def recorder(machine: int) -> str:
    """Half of the machines of every build are recorded as by real recorders."""
    return "as recorded" if machine // 4 % 2 == machine % 2 else "clean"


def _deck(names: Sequence[str], rng: np.random.Generator) -> Iterator[str]:
    while True:
        yield from (str(name) for name in rng.permutation(names))


def _draw_effect(name: str, arm: Arm, strength: float, rng: np.random.Generator) -> dict[str, Any]:
    n = arm.n
    joint = int(rng.integers(n))
    if name in _GEARS or name == "gravity_spring":
        joint = int(rng.integers(1, 3))
    elif name == "dress_pack":
        joint = int(rng.integers(n - 3, n))
    elif name == "encoder_offset":
        joint = int(rng.integers(1, 4 if n == 7 else 3))
    joints = [arm.joint_names[joint]]
    if name == "wrist_coupling":
        joints = [arm.joint_names[n - 2], arm.joint_names[n - 1]]
    if name in ("payload", "base_tilt", "inertial_mismatch", "contact", "time_delay"):
        joints = []
    make = _sizes(arm, joint, strength, rng)[name]
    return {"effect": name, "joints": joints, "parameters": make()}


def _sizes(arm: Arm, k: int, s: float, rng: np.random.Generator) -> dict[str, Callable[[], dict[str, Any]]]:
    """Parameters of every effect; at s = 1 a few percent of nominal torque."""
    torque, speed, n = float(arm.torque[k]), float(arm.speed[k]), arm.n
    sign = float(rng.choice([-1.0, 1.0]))

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def vector(size: float) -> list[float]:
        way = rng.normal(size=3)
        return [float(x) for x in size * way / np.linalg.norm(way)]

    beyond = float(arm.mass[k:].sum() * 0.3**2)  # about what hangs on the joint [kg·m²]
    heft = float(arm.torque[1] / 9.81)  # kg at 1 m that the shoulder holds
    return {
        "payload": lambda: {"mass": 0.08 * s * heft, "centre": [draw(-0.05, 0.05), draw(-0.05, 0.05), draw(0, 0.15)]},
        "friction_change": lambda: {"coulomb": 1 + draw(0.4, 0.8) * s, "viscous": 1 + draw(0, 0.5) * s},
        "stribeck": lambda: {"rise": 0.06 * s * torque, "speed": draw(0.015, 0.06) * speed},
        "asymmetric_friction": lambda: {"coulomb": sign * min(0.35 * s, 0.8), "viscous": sign * min(0.3 * s, 0.8)},
        "load_dependent_friction": lambda: {"coefficient": 0.12 * s},
        "viscous_nonlinearity": lambda: {
            "added": 0.25 * s * torque / speed,
            "speed": draw(0.04, 0.12) * speed,
            "power": draw(0.25, 0.4),
        },
        "thermal_friction": lambda: {"coulomb": 0.5 * s, "viscous": 0.8 * s, "way": draw(2, 8)},
        "presliding": lambda: {"share": draw(0.6, 0.9), "travel": 0.02 * s},
        "gravity_spring": lambda: {"torque": 0.35 * s * torque, "lever": draw(0.2, 0.5), "angle": draw(-0.6, 0.6)},
        "dress_pack": lambda: {
            "stiffness": 0.12 * s * torque,
            "centre": draw(-0.5, 0.5),
            "slack": draw(0.0, 0.4),
            "rubbing": 0.03 * s * torque,
        },
        "base_tilt": lambda: {"roll": sign * 0.03 * s, "pitch": draw(-0.03, 0.03) * s},
        "inertial_mismatch": lambda: {
            "link": int(rng.integers(1, n - 1)),
            "scale": 1 + 0.2 * s,
            "mass": 0.1 * s * heft,
            "place": vector(0.15),
        },
        "contact": lambda: {
            "link": int(rng.integers(2, n)),
            "force": vector(0.35 * s * float(arm.torque[1])),
            "starts": [draw(0.05, 0.15), draw(0.55, 0.65)][: int(rng.integers(1, 3))],
            "duration": draw(0.05, 0.3),
        },
        "torque_constant": lambda: {"scale": 1 + sign * 0.12 * s},
        "torque_offset": lambda: {"offset": sign * 0.06 * s * torque},
        "time_delay": lambda: {"delay": 0.006 * s},
        "encoder_offset": lambda: {"offset": sign * 0.03 * s},
        "joint_elasticity": lambda: {
            "stiffness": beyond * (2 * np.pi * draw(6, 10)) ** 2 / s,
            "damping": 0.08 * beyond * 2 * np.pi * 8,
        },
        "backlash": lambda: {"gap": 0.01 * s, "damping": 0.02 * beyond * 2 * np.pi * 8},
        "torque_ripple": lambda: {
            "amplitude": 0.06 * s * torque,
            "order": float(rng.choice([0.5, 1.0, 2.0])) if speed < 3 else 0.5,
            "phase": draw(0, 6),
        },
        "wrist_coupling": lambda: {
            "ratio": sign * draw(0.4, 1.6),
            "moved": float(rng.random() < 0.5),
            "coulomb": 0.05 * s * float(arm.torque[-1]),
            "viscous": 0.05 * s * float(arm.torque[-1] / arm.speed[-1]),
        },
        "crosstalk": lambda: {"from": int((k + 2) % n), "share": 0.3 * s * torque / float(arm.torque[(k + 2) % n])},
        "shaking_floor": lambda: {"amplitude": 0.08 * s * torque, "frequency": draw(2, 8)},
        "holding_sensor": lambda: {"every": 0.8, "length": 0.1 * s, "seed": int(rng.integers(1_000_000))},
        "clipped_torque": lambda: {"limit": 0.45 * torque / s},
    }
