"""A world: one healthy machine with its servo, friction law, sensors, motions and recorder, all drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from second_world.arms import CLASSES, Arm, draw_arm
from second_world.motions import KINDS

#: Which laws are drawn: some are kept for judgement alone.
LAWS = ("development", "judgement")
FRICTION = ("lugre", "maxwell_slip", "thermal_stribeck", "load_and_posture")
VELOCITY = ("exact", "lagged", "missing")
RATES = (100.0, 125.0, 200.0, 250.0, 500.0, 1000.0)
#: What a recorder does to logs; half of the machines have a clean one.
RECORDER_FAULTS = ("rounded", "late", "lossy", "duplicated", "gap")

_STIFFEST = 2e5  # 1/s²: bristles over the rotor's inertia, which steps of half a millisecond can follow


@dataclass(frozen=True, eq=False)
class DrawnWorld:
    """Everything that is drawn once per machine; n joints.

    `friction_rows` (n, 13), `servo_rows` (n, 14) and `terms` (T, 8) are as `second_world.kernel` takes them.
    `encoder` (n,) [rad] a count, `noise` of the torque channel over nominal, `tracking` whether logs carry set-points.
    """

    machine: int
    laws: str
    arm: Arm
    friction: str
    friction_rows: np.ndarray
    servo: str
    servo_rows: np.ndarray
    terms: np.ndarray
    encoder: np.ndarray
    noise: float
    velocity: str
    rate: float
    tracking: bool
    motions: dict[str, str]
    faults: tuple[str, ...]

    @property
    def recorder(self) -> str:
        """How the logs are kept."""
        return "as recorded" if self.faults else "clean"

    def to_dict(self) -> dict[str, Any]:
        """What was drawn, in words and as plain data."""
        names = ("laws", "friction", "servo", "velocity", "rate", "tracking", "motions")
        drawn = {name: getattr(self, name) for name in names}
        return {"arm": self.arm.kind.name, **drawn, "faults": list(self.faults)}


def machine_number(seed: int, group: int, laws: str) -> int:
    """Number of the machine of a group of runs; development and judgement never share one.

    The lowest bit says for which of LAWS it is drawn, the next two the class of the arm, which all take turns. The rest
    are 60 random bits, too many to try: whoever knew them could run the machine again without its effect.
    """
    first = int(np.random.default_rng(np.random.SeedSequence([LAWS.index(laws), seed, 1])).integers(4))
    rng = np.random.default_rng(np.random.SeedSequence([LAWS.index(laws), seed, 1, group]))
    return 2 * (4 * int(rng.integers(2**60)) + (first + group) % 4) + LAWS.index(laws)


def draw_world(machine: int) -> DrawnWorld:
    """The world of a machine's number."""
    laws = LAWS[machine % 2]
    rng = np.random.default_rng(np.random.SeedSequence([machine, 5]))
    kind = CLASSES[machine // 2 % len(CLASSES)]
    arm = draw_arm(kind, rng)
    friction = str(rng.choice(FRICTION))
    servo = str(rng.choice(("computed", "cascade", "pid")))
    terms = [
        [70, k, arm.torque[k] * rng.uniform(2e-4, 2e-3), kind.ratio * order, rng.uniform(0, 6), 0.3, 0.0, 0.0]
        for k, order in enumerate(rng.choice([2.0, 4.0, 6.0], arm.n))
    ]  # cogging
    if kind.balance:
        terms.append(
            [51, 1, kind.balance * arm.torque[1] * rng.uniform(0.8, 1.1), 0.0, rng.uniform(0.2, 0.45), 0, 0, 0]
        )
    faults = tuple(str(name) for name in RECORDER_FAULTS if rng.random() < 0.5) if rng.random() < 0.5 else ()
    return DrawnWorld(
        machine,
        laws,
        arm,
        friction,
        _friction_rows(friction, arm, rng),
        servo,
        _servo_rows(servo, arm, rng),
        np.array(terms, dtype=float),
        2 * np.pi / (2.0 ** rng.integers(12, 18) * kind.ratio) * np.ones(arm.n),
        float(np.exp(rng.uniform(np.log(0.001), np.log(0.006)))),
        str(rng.choice(VELOCITY)),
        float(rng.choice(RATES)),
        bool(rng.random() < 0.5),
        {role: str(rng.choice(kinds)) for role, kinds in KINDS.items()},
        faults,
    )


def _friction_rows(law: str, arm: Arm, rng: np.random.Generator) -> np.ndarray:
    n = arm.n
    coulomb = arm.torque * rng.uniform(*arm.kind.friction, n)
    rows = np.zeros((n, 13))
    rows[:, 0] = law == "maxwell_slip"
    rows[:, 1] = coulomb
    rows[:, 2] = coulomb * rng.uniform(0.02, 0.15, n)
    rows[:, 3] = arm.speed * rng.uniform(0.005, 0.02, n)
    rows[:, 4] = arm.torque * rng.uniform(0.03, 0.1, n) / arm.speed
    rows[:, 5] = np.minimum(coulomb / np.exp(rng.uniform(np.log(5e-5), np.log(5e-4), n)), _STIFFEST * arm.rotor)
    rows[:, 9] = 1.0
    if law == "thermal_stribeck":  # warms by up to 10 K at full speed
        rows[:, 6], rows[:, 7] = rng.uniform(5e-4, 0.002, n), rng.uniform(0.002, 0.008, n)
        rows[:, 8] = rng.uniform(5.0, 10.0, n) / (0.3 * coulomb * arm.speed)
        rows[:, 9] = rng.uniform(40.0, 300.0, n)
    if law == "load_and_posture":
        rows[:, 10] = rng.uniform(0.005, 0.03, n)
        rows[:, 11], rows[:, 12] = rng.uniform(0.0, 0.06, n), rng.uniform(-np.pi, np.pi, n)
    return rows


def _servo_rows(servo: str, arm: Arm, rng: np.random.Generator) -> np.ndarray:
    """Gains by what an outstretched arm weighs; the plant scales them by the inertia it finds."""
    n = arm.n
    frequency = 2 * np.pi * rng.uniform(3.5, 7.0, n)
    rows = np.zeros((n, 14))
    rows[:, 0] = {"computed": rng.uniform(0.85, 1.1, n), "cascade": np.zeros(n), "pid": rng.uniform(0.5, 0.9, n)}[servo]
    rows[:, 1] = {"computed": rng.uniform(0.6, 1.0, n), "cascade": rng.uniform(0.5, 1.0, n), "pid": np.zeros(n)}[servo]
    rows[:, 2], rows[:, 3] = frequency**2, 1.6 * frequency
    rows[:, 4] = 0.0 if servo == "computed" else 0.5 * frequency**3 * rng.uniform(0.2, 0.5, n)
    rows[:, 5] = 8 * arm.torque / 2.0 ** rng.integers(11, 15)
    rows[:, 6] = 2 * np.pi * rng.uniform(80.0, 400.0)  # bandwidth of the current loop
    rows[:, 8] = 1.0
    rows[:, 10] = arm.rotor
    rows[:, 11] = rng.random() < 0.3
    rows[:, 13] = 6 * arm.torque
    return rows
