"""Effect by size by joint on simulated runs: `python benchmarks/diagnosis_matrix.py [--sizes S…] [--joints J…]`.

The fake controller's plant follows three motions of 20 s each; a model is estimated from two effect-free ones, then
runs with no effect or one are diagnosed, and with --withheld once more with that effect out of the catalogue. Sizes
count in what an effect usually is on a machine in need of repair. Each line is one run; a table ends it.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import workers

from agent.core.errors import AgentError
from agent.diagnosis import diagnose
from agent.estimation import estimate
from agent.model import CATALOGUE, IdentifiedModel
from agent.recording.log import Log
from agent.robot import RobotDescription, load_robot
from fake_controller.plant import Plant
from fake_controller.withheld.cases import draw_effect

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


def draw(name: str, robot: RobotDescription, size: float, joint: str | None, rng: np.random.Generator) -> dict | None:
    """An effect `size` times as large as usual, as the blind check draws it; on a joint, or None where it sits on none.

    Effects of the whole arm come once, for the first joint asked.
    """
    for _ in range(200):
        effect = draw_effect(name, robot, size, rng)
        if joint is None or joint in effect["joints"] or (not effect["joints"] and joint == robot.joint_names[0]):
            return effect
    return None


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


def table(outcomes: dict[tuple[str, float], list[str]], sizes: list[float]) -> str:
    """Effect by size: how many of the joints tried were told right or in a class with the truth."""
    lines = [f"{'effect':26}" + "".join(f"{f'x {size:g}':>14}" for size in sizes)]
    for name in dict.fromkeys(effect for effect, _ in outcomes):
        cells = []
        for size in sizes:
            told = outcomes.get((name, size), [])
            good = sum(outcome in ("right", "class") for outcome in told)
            missed = told.count("missed")
            cells.append(f"{good}/{len(told)}" + (f" ({missed} -)" if missed else "") if told else "")
        lines.append(f"{name:26}" + "".join(f"{cell:>14}" for cell in cells))
    return "\n".join([*lines, "right or in class / tried; (k -): k times no gap was seen"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="comau_ns16")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--none", type=int, default=3, help="effect-free runs")
    parser.add_argument("--sizes", type=float, nargs="*", default=[0.25, 0.5, 1.0, 2.0], help="times the usual size")
    parser.add_argument("--joints", nargs="*", help="these joints; one is drawn for every run if none is named")
    parser.add_argument("--only", nargs="*", help="these effects")
    parser.add_argument("--withheld", action="store_true", help="diagnose again without the true effect")
    parser.add_argument("--keep", type=Path, help="folder for models that are reused")
    workers.add_options(parser)
    arguments = parser.parse_args()
    robot = load_robot(arguments.robot)
    rng = np.random.default_rng(arguments.seed)
    names = arguments.only if arguments.only is not None else list(CATALOGUE)
    places = [(name, size, joint) for name in names for size in arguments.sizes for joint in arguments.joints or [None]]
    truths = [("none", 0.0, None)] * arguments.none
    truths += [(name, size, draw(name, robot, size, joint, rng)) for name, size, joint in places]
    truths = [entry for entry in truths if entry[0] == "none" or entry[2] is not None]
    cases = [
        (arguments.robot, arguments.seed * 100 + number // 8, number, *truth, arguments.withheld, arguments.keep)
        for number, truth in enumerate(truths)
    ]
    outcomes: dict[tuple[str, float], list[str]] = {}
    withheld: Counter[str] = Counter()
    for truth, (text, outcome, without) in zip(truths, workers.worked(try_case, cases, arguments), strict=True):
        print(text, flush=True)
        if outcome:
            outcomes.setdefault(truth[:2], []).append(outcome)
        withheld.update([without] if without else [])
    print(table(outcomes, [0.0, *arguments.sizes]))
    if withheld:
        print(f"with the true effect withheld: {dict(withheld)}")


def try_case(case: tuple) -> tuple[str, str, str]:
    """One run recorded and diagnosed: what to print, the outcome, and that with the true effect withheld."""
    arm, machine, number, name, size, effect, withheld, keep = case
    robot, model = load_robot(arm), model_of(arm, machine, keep)
    truth = [] if effect is None else [effect]
    try:
        logs = [record(robot, machine, truth, kind, 1000 + number) for kind in MOTIONS]
    except AgentError as error:
        return f"{name}: {error}", "", ""
    start = time.process_time()
    result = diagnose(robot, logs, model).result
    seconds = time.process_time() - start
    outcome = judge(result, truth)
    text = f"{outcome:11} {seconds:5.1f}s x {size:g} {json.dumps(effect)}\n      {short(result)}"
    if not (withheld and truth):
        return text, outcome, ""
    found = diagnose(robot, logs, model, without=[name])
    text += f"\n      without: {short(found.result)} closed {found.finding.closed:.3f}"
    return text, outcome, "confident" if found.result["verdict"] == "explained" else "abstains"


@functools.lru_cache(maxsize=1)
def model_of(arm: str, machine: int, keep: Path | None) -> IdentifiedModel:
    """The model of a machine, from two effect-free motions; the same in every process."""
    robot = load_robot(arm)
    return cached(
        keep, f"model_{robot.name}_{machine}",
        lambda: estimate(robot, [record(robot, machine, [], kind, machine) for kind in MOTIONS[:2]]),
    )  # fmt: skip


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
