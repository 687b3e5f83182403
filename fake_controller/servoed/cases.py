"""Which runs this world holds, drawn from a seed: arms, effects, recorders and motions."""

from __future__ import annotations

from typing import Any

import numpy as np

from fake_controller.actuation.effect import OUTSIDE
from fake_controller.servoed.arms import GRAVITY, DrawnArm, draw_arm
from fake_controller.withheld.cases import deck, kinds_of

SHARES = {"none": 1 / 3, "one": 0.4, "two": 2 / 15, "outside": 2 / 15}
#: Effects of the catalogue that positions and commands can show.
EFFECTS = (
    "time_delay", "friction_change", "backlash", "stribeck", "presliding", "payload", "torque_constant",
    "torque_offset",
)  # fmt: skip
#: Effects of servos that no catalogue has a name for.
SERVO_FAULTS = ("integrating_servo", "sagging_supply")
OF_THE_ARM = ("payload", "sagging_supply")
RATES = (30.0, 50.0, 100.0, 200.0)
MOTIONS = ("planned", "led", "both")


def draw_cases(count: int, seed: int) -> list[dict[str, Any]]:
    """`count` runs in random order; every effect comes up equally often. Seeds have 62 random bits each."""
    rng = np.random.default_rng([seed, 20])
    kinds = [str(kind) for kind in rng.permutation(kinds_of(count, SHARES))]
    inside, beyond = deck(EFFECTS, rng), deck((*OUTSIDE, *SERVO_FAULTS), rng)
    cases = []
    for number, kind in enumerate(kinds):
        machine, motion = (int(part) for part in rng.integers(2**62, size=2))
        arm, rate = draw_arm(machine), float(rng.choice(RATES))
        names = [next(beyond if kind == "outside" else inside) for _ in range({"none": 0, "two": 2}.get(kind, 1))]
        effects = [_drawn(name, arm, rate, rng) for name in names]
        recorder = {
            "rate": rate,
            "jitter": float(np.exp(rng.uniform(np.log(1e-4), np.log(1e-3)))),
            "clipped": bool(rng.random() < 0.2),
            "format": str(rng.choice(["lerobot", "csv"], p=[0.7, 0.3])),
        }
        cases.append(
            {
                "number": number,
                "kind": kind,
                "machine": machine,
                "motion": motion,
                "motions": str(rng.choice(MOTIONS)),
                "effects": effects,
                "recorder": "clipped" if recorder["clipped"] else "plain",
                "frames": recorder,
                "arm": arm.kind.name,
                "joints": len(arm.kp),
                "on_link": arm.on_link,
            }
        )
    return cases


def _drawn(name: str, arm: DrawnArm, rate: float, rng: np.random.Generator) -> dict[str, Any]:
    """An effect of a size at which somebody would look for it."""
    k, hobby = int(rng.integers(len(arm.kp))), arm.kind.name == "hobby"
    coulomb, sign, size = float(arm.coulomb[k]), float(rng.choice([-1, 1])), float(rng.uniform(0.5, 1.5))
    share, other, seed = float(rng.uniform()), float(rng.uniform()), float(k)
    reach = float(np.linalg.norm(arm.origin, axis=1).sum())
    centre = 0.1 * reach * rng.uniform([0.2, -0.5, -0.5], [1.0, 0.5, 0.5])
    lifted, whole = float(arm.load.max()) / GRAVITY / reach, float(arm.load.sum() + arm.coulomb.sum())
    play = 0.6 + 1.6 * share if hobby else 0.15 + 0.45 * share
    drawn: dict[str, dict[str, Any]] = {
        "time_delay": {"delay": max(0.01, (0.5 + 2.5 * share) / rate)},
        "friction_change": {"coulomb": (0.8 + 0.4 * share) * (2.5 if sign > 0 else 0.4), "missing": other < 0.3},
        "backlash": {"gap": float(np.radians(play))},
        "stribeck": {"rise": size * coulomb, "speed": 0.03 + 0.12 * share},
        "presliding": {"share": 0.6 + 0.3 * share, "travel": size * (0.03 if hobby else 0.008)},
        "payload": {"mass": 0.4 * size * lifted, "centre": centre.tolist(), "radius": 0.05 * reach},
        "torque_offset": {"set_point_offset": sign * size * (0.02 if hobby else 0.005)},
        "torque_constant": {"gain": float(np.exp(sign * (0.2 + 0.4 * share)))},
        "integrating_servo": {"integral": 1.0 + 3.0 * share},
        "sagging_supply": {"sag": 0.6 * size / whole},
        "rough_bearing": {"amplitude": 2.0 * size * coulomb, "patch": 0.05 + 0.15 * share, "seed": seed},
        "wandering_torque": {"amplitude": size * coulomb, "memory": 0.2 + 1.3 * share, "seed": seed},
        "rubbing_brake": {"drag": 2.0 * size * coulomb, "on": 0.5, "off": 1.5, "seed": seed},
    }
    of_arm = name in OF_THE_ARM or (name == "time_delay" and other < 0.6)
    joints = [] if of_arm else [arm.names[k]]
    return {"effect": name, "joints": joints, "parameters": drawn[name]}
