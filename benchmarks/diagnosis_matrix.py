"""Confusion matrix of the diagnosis on simulated runs: `python benchmarks/diagnosis_matrix.py [--cases N] [--seed S]`.

The fake controller's plant follows three motions of 20 s each; a model is estimated from two effect-free ones, then
runs with no effect or one are diagnosed, and once more with that effect out of the catalogue. Each line is one run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from agent.diagnosis import diagnose
from agent.errors import AgentError
from agent.estimation import IdentifiedModel, estimate
from agent.recording.log import Log
from agent.robot import RobotDescription, load_robot
from fake_controller.plant import Plant

# ruff: noqa: E501

PERIOD = 0.002
CYCLE = 10.0
MOTIONS = ("excite", "moves", "slow")


def set_points(robot: RobotDescription, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(S, n) positions and velocities of two cycles of one motion."""
    rng = np.random.default_rng([seed, MOTIONS.index(kind)])
    lower, upper = (np.clip(limit, -2.5, 2.5) for limit in robot.position_limits)
    middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
    time = np.arange(round(CYCLE / PERIOD)) * PERIOD
    if kind == "excite":
        harmonics = np.arange(1, 6)
        a, b = rng.normal(size=(2, 5, robot.dof)) / harmonics[:, None]
        phase = 2 * np.pi * harmonics * time[:, None] / CYCLE
        q, qd = np.sin(phase) @ a + np.cos(phase) @ b, 0.0
        fade = np.sin(np.pi * np.clip(np.minimum(time, CYCLE - time) / 1.0, 0, 1) / 2)[:, None] ** 2
        q = fade * (q - q[0])
        qd = np.gradient(q, PERIOD, axis=0)
        qdd = np.gradient(qd, PERIOD, axis=0)
        scale = np.min(
            [
                0.6 * robot.max_velocity / np.abs(qd).max(axis=0),
                0.6 * robot.max_acceleration / np.abs(qdd).max(axis=0),
                0.6 * half / np.abs(q).max(axis=0),
            ],
            axis=0,
        )
        q = middle + q * scale
    else:
        speed = 0.7 if kind == "moves" else 0.08
        points, rows = middle + rng.uniform(-0.5, 0.5, (60, robot.dof)) * half, []
        at, left = middle, len(time) - 1100
        for target in points:
            way = np.abs(target - at)
            by_speed = 1.9 * way / (speed * robot.max_velocity)
            lasting = max(by_speed.max(), np.sqrt(6 * way / (0.7 * robot.max_acceleration)).max())
            if kind == "slow" and lasting > 3.5:
                target, lasting = at + (target - at) * 3.5 / lasting, 3.5
            samples = max(2, round(lasting / PERIOD))
            if samples + 100 > left:
                break
            rows += [at + blend(samples) * (target - at), np.repeat(target[None], 100, axis=0)]
            at, left = target, left - samples - 100
        rows += [at + blend(1000) * (middle - at), np.repeat(middle[None], left + 100, axis=0)]
        q = np.concatenate(rows)
    q = np.concatenate([q, q])
    return q, np.gradient(q, PERIOD, axis=0)


def blend(samples: int) -> np.ndarray:
    """(samples, 1) from 0 to 1 with no speed or acceleration at either end."""
    s = np.linspace(0, 1, samples)[:, None]
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def record(robot: RobotDescription, seed: int, effects: list, kind: str, motion_seed: int) -> Log:
    """A log of one motion, as a reader would give it."""
    planned, planned_velocity = set_points(robot, kind, motion_seed)
    plant = Plant(robot, seed=seed, effects=effects)
    q, qd = plant.executed_path(planned, planned_velocity)
    plant.rest(q[0])
    chunks = list(plant.run(q, qd))
    size = min(len(planned), len(q))
    position, velocity, torque = (
        np.concatenate([getattr(c, part) for c in chunks])[:size] for part in ("position", "velocity", "torque")
    )
    return Log(
        path=Path(f"{kind}.mcap"),
        joint_names=robot.joint_names,
        t=np.arange(size) * PERIOD,
        position=position,
        velocity=velocity,
        effort=torque,
        reference_position=q[:size],
        planned_position=planned[:size],
        sample_rate=1 / PERIOD,
        stamp=0.0,
        segments=((0, size),),
        cycle_starts=(0.0, CYCLE),
    )


def draw(name: str, robot: RobotDescription, rng: np.random.Generator) -> dict:
    """A random effect of a few percent of nominal torque."""
    n = robot.dof
    k = int(rng.integers(n))
    nominal = float(np.nan_to_num(robot.nominal_torque, nan=100.0)[k])
    fastest = float(robot.max_velocity[k])
    gear = abs(float(robot.gear_ratios[k]))
    sign = float(rng.choice([-1, 1]))
    size = float(rng.uniform(0.03, 0.1))
    if name in ("joint_elasticity", "backlash"):
        k = int(rng.integers(1, min(n, 3)))
    if name == "encoder_offset":
        k = int(rng.integers(1, n - 1))
    inertia = {0: 90.0, 1: 110.0, 2: 25.0}.get(k, 1.0)
    parameters: dict[str, Callable[[], dict]] = {
        "stribeck": lambda: {"rise": size * nominal, "speed": rng.uniform(0.02, 0.08) * fastest},
        "asymmetric_friction": lambda: {"coulomb": sign * rng.uniform(0.15, 0.4), "viscous_fraction": sign * rng.uniform(0.2, 0.5)},
        "load_dependent_friction": lambda: {"coefficient": rng.uniform(0.08, 0.2)},
        "viscous_nonlinearity": lambda: {"torque": 1.2 * size * nominal, "speed": rng.uniform(0.02, 0.06) * fastest},
        "thermal_friction": lambda: {
            "start": -25.0, "time_constant": rng.uniform(4, 15), "coulomb_rate": rng.uniform(0.008, 0.016),
            "viscous_rate": rng.uniform(0.01, 0.03),
        },
        "presliding": lambda: {"share": rng.uniform(0.6, 0.9), "travel": rng.uniform(0.01, 0.04)},
        "friction_change": lambda: {"coulomb": rng.uniform(1.2, 1.6), "viscous": rng.uniform(1.0, 1.6)},
        "joint_elasticity": lambda: {"stiffness": inertia * (2 * np.pi * rng.uniform(7, 12)) ** 2},
        "backlash": lambda: {"gap": rng.uniform(0.001, 0.003)},
        "torque_ripple": lambda: {"amplitude": size * nominal, "order": float(rng.choice([0.5, 1, 2])), "phase": rng.uniform(0, 6)},
        "wrist_coupling": lambda: {"factor": sign * rng.uniform(0.1, 0.4)},
        "payload": lambda: {"mass": rng.uniform(1, 6), "centre": [*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.02, 0.2)]},
        "gravity_spring": lambda: {"preload": size * nominal / 0.1, "rate": rng.uniform(0, 1) * nominal, "angle": rng.uniform(-1, 1)},
        "dress_pack": lambda: {"stiffness": 0.7 * size * nominal, "centre": rng.uniform(-1, 1), "hysteresis": 0.3 * size * nominal},
        "base_tilt": lambda: {"roll": sign * rng.uniform(0.01, 0.04), "pitch": rng.uniform(-0.03, 0.03)},
        "inertial_mismatch": lambda: {
            "link": float(rng.integers(2, n)), "scale": rng.uniform(1.1, 1.3), "points": [[rng.uniform(2, 8), *rng.uniform(-0.3, 0.3, 3)]],
        },
        "contact": lambda: {"force": list(rng.uniform(-1, 1, 3) * 120), "start": rng.uniform(2, 15), "duration": rng.uniform(0.5, 3)},
        "torque_constant": lambda: {"scale": 1 + sign * rng.uniform(0.06, 0.15)},
        "torque_offset": lambda: {"offset": sign * size * nominal},
        "time_delay": lambda: {"delay": rng.uniform(0.003, 0.01)},
        "encoder_offset": lambda: {"offset": sign * rng.uniform(0.01, 0.04)},
        "interpolator_mismatch": lambda: {"rate": 1 + sign * rng.uniform(0.01, 0.03), "blend": rng.uniform(0.0, 0.08)},
    }  # fmt: skip
    del gear
    arm = ("payload", "base_tilt", "inertial_mismatch", "contact", "time_delay", "interpolator_mismatch")
    joints = [] if name in arm else [robot.joint_names[k]]
    if name == "wrist_coupling":
        joints = list(robot.joint_names[-2:])
    return {"effect": name, "joints": joints, "parameters": parameters[name]()}


def judge(result: dict, truth: list[dict]) -> str:
    """right, class, joint (wrong effect, right joint), wrong, unknown, missed or false alarm."""
    verdict = result["verdict"]
    if not truth:
        return "right" if verdict == "no_gap" else "FALSE ALARM"
    if verdict in ("no_gap", "unknown"):
        return "missed" if verdict == "no_gap" else "unknown"
    name, joints = truth[0]["effect"], truth[0]["joints"]
    cause = result["causes"][0]
    if cause["effect"] == name and set(cause["joints"]) == set(joints):
        return "right"
    if any(e["effect"] == name and set(e["joints"]) == set(joints) for e in cause["equivalent_to"]):
        return "class"
    return "joint" if joints and cause["joints"] == joints else "wrong"


def short(result: dict) -> str:
    """Verdict and causes on one line."""
    causes = [
        f"{c['effect']}@{','.join(j[-1] for j in c['joints'])}(p{c['probability']:.2f}"
        + "".join(f" ~{e['effect']}@{','.join(j[-1] for j in e['joints'])}" for e in c["equivalent_to"])
        + ")"
        for c in result["causes"]
    ]
    closure = result["closure"]
    return f"{result['verdict']:9} {'-' if closure is None else format(closure, '.3f')} {' + '.join(causes)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="comau_ns16")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--none", type=int, default=3, help="effect-free runs")
    parser.add_argument("--each", type=int, default=1, help="runs of every effect")
    parser.add_argument("--only", nargs="*", help="these effects")
    parser.add_argument("--withheld", action="store_true", help="diagnose again without the true effect")
    parser.add_argument("--keep", type=Path, help="folder for models and logs that are reused")
    arguments = parser.parse_args()
    robot = load_robot(arguments.robot)
    rng = np.random.default_rng(arguments.seed)
    from agent.diagnosis import CATALOGUE

    names = arguments.only if arguments.only is not None else list(CATALOGUE)
    runs = [None] * arguments.none + [name for name in names for _ in range(arguments.each)]
    model, machine = None, 0
    counts: Counter = Counter()
    for number, name in enumerate(runs):
        if model is None or number % 8 == 0:
            machine = arguments.seed * 100 + number // 8
            model = cached(
                arguments.keep, f"model_{robot.name}_{machine}",
                lambda m=machine: estimate(robot, [record(robot, m, [], kind, m) for kind in MOTIONS[:2]]),
            )  # fmt: skip
        truth = [] if name is None else [draw(name, robot, rng)]
        try:
            logs = [record(robot, machine, truth, kind, 1000 + number) for kind in MOTIONS]
        except AgentError as error:
            print(f"{name}: {error}")
            continue
        start = time.process_time()
        found = diagnose(robot, logs, model)
        result = found.result
        seconds = time.process_time() - start
        outcome = judge(result, truth)
        counts[outcome] += 1
        print(
            f"{outcome:11} {seconds:5.1f}s {json.dumps(truth[0]) if truth else 'none'}\n      {short(result)}",
            flush=True,
        )
        if arguments.withheld and truth:
            found = diagnose(robot, logs, model, without=[name])
            result = found.result
            confident = result["verdict"] == "explained"
            counts["withheld: confident" if confident else "withheld: abstains"] += 1
            print(f"      without: {short(result)} closed {found.finding.closed:.3f}", flush=True)
    print(dict(counts))


def cached(folder: Path | None, name: str, make: Callable[[], IdentifiedModel]) -> IdentifiedModel:
    """A model from a file of that name, made where there is none."""
    if folder is None:
        return make()
    path = folder / f"{name}.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        make().save(path)
    return IdentifiedModel.load(path)


if __name__ == "__main__":
    main()
