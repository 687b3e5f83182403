"""A synthetic fleet with known wear, steps and causes: small logs of it, or a year of results at once.

Friction of every axle is a level of its own with scatter from run to run, raised by a warm-up that all axles of a
machine share, and changed by what was planted:

- wear: one axle of a machine drifts, linear in time;
- step: one axle of a machine jumps at some week (a new grease);
- cause: all machines of one lubricant batch drift on the same axle.

`truth.csv` lists what was planted, `machines.csv` has the columns a plant would bring (cell, lubricant batch). Torque
in logs is inverse dynamics of the description plus rotors, friction with a smooth reversal, and noise.
"""

from __future__ import annotations

import itertools
from dataclasses import astuple, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from agent.core import InputError, csv_text
from agent.fleet.result_file import ROWS, schema
from agent.fleet.store import Store
from agent.recording import Log, write_log
from agent.robot import Dynamics, RobotDescription, load_robot

#: Share of the machines with each kind of change, and its relative size.
SHARES = {"cause": 0.05, "wear": 0.02, "step": 0.01}
CHANGES = {"cause": 0.06, "wear": 0.10, "step": -0.15}
SCATTER = 0.004  # of friction from run to run
WARM_UP = 0.05  # largest relative increase of friction of a cold arm
_DECAY = 600.0  # s, of the warm-up
_DOUBT = 1.2e-5  # 1/s, standard deviation of the rate of warm-up within a run
_CELLS, _BATCHES = 12, 20
_BAD_BATCH = "B07"
_START = datetime(2025, 1, 6, 2, 0, tzinfo=UTC)
_CYCLES, _PERIOD, _RATE = 4, 5.0, 100.0  # of the motion of a log: cycles, s, Hz
_REVERSAL = 0.01  # share of the highest speed over which friction changes sign
_NOISE = 0.003  # of nominal torque


@dataclass(frozen=True)
class Planted:
    """A change of the friction of one axle: `kind`, relative size at the end, and the week in which it begins."""

    robot: str
    joint: str
    kind: str
    change: float
    week: int


@dataclass(frozen=True, eq=False)
class Fleet:
    """A drawn fleet of N machines over W weeks: their columns, what was planted, and the relative friction (N, W, n) of
    axles; the warm-up `cold` (N, W) and the response `answer` (N, n) of every axle to it."""

    names: tuple[str, ...]
    columns: tuple[tuple[str, str], ...]
    planted: tuple[Planted, ...]
    friction: np.ndarray
    cold: np.ndarray
    answer: np.ndarray


def draw_fleet(machines: int, weeks: int, joints: tuple[str, ...], seed: int) -> Fleet:
    """Draw a fleet; the same for the same seed.

    Raises:
        InputError: no machine or no week.
    """
    if machines < 1 or weeks < 1:
        raise InputError("fleet simulate: at least one machine (-n) and one week (--weeks) are needed")
    rng = np.random.default_rng(seed)
    n = len(joints)
    names = tuple(f"robot_{k:0{max(4, len(str(machines - 1)))}d}" for k in range(machines))
    order = rng.permutation(machines)
    kinds = [kind for kind, share in SHARES.items() for _ in range(max(kind == "wear", round(share * machines)))]
    batches = rng.permutation([f"B{k % _BATCHES:02d}" for k in range(machines)]).astype(object)
    batches[batches == _BAD_BATCH] = "B08"
    batches[order[: kinds.count("cause")]] = _BAD_BATCH
    part = np.arange(weeks) / max(1, weeks - 1)
    change = np.zeros((machines, weeks, n))
    planted = []
    shared = int(rng.integers(n))
    for machine, kind in zip(order, kinds, strict=False):
        axle = shared if kind == "cause" else int(rng.integers(n))
        week = int(rng.integers(weeks // 4, max(weeks // 4 + 1, 3 * weeks // 4))) if kind == "step" else 0
        change[machine, :, axle] = CHANGES[kind] * (np.arange(weeks) >= week if kind == "step" else part)
        planted.append(Planted(names[machine], joints[axle], kind, CHANGES[kind], week))
    answer = rng.uniform(0.5, 1.5, (machines, n))
    cold = WARM_UP * rng.uniform(size=(machines, weeks))
    scatter = SCATTER * rng.normal(size=(machines, weeks, n))
    friction = (1 + answer[:, None] * cold[..., None]) * (1 + change) * (1 + scatter)
    columns = tuple((f"cell_{k % _CELLS:02d}", str(batches[k])) for k in range(machines))
    return Fleet(names, columns, tuple(sorted(planted, key=lambda change: change.robot)), friction, cold, answer)


def simulate_fleet(robot: str, machines: int, weeks: int, seed: int, out: str, rows: bool) -> list[str]:
    """Write a fleet to a folder or URL: logs with their description, or with `rows` the result of `fleet estimate` on
    a year of them; returns what was written.

    Args:
        robot: name or file of its description.
        machines: number of machines.
        weeks: number of weeks with logs.
        seed: of all draws.
        out: folder or URL.
        rows: write a result of a year instead of logs.

    Raises:
        InputError: a robot that is not known, or a folder with something else in it.
    """
    description = load_robot(robot)
    store = Store(out)
    if store.names("."):
        raise InputError(f"{out}: there is something in it already; name a new folder")
    fleet = draw_fleet(machines, weeks, description.joint_names, seed)
    written = _write_rows(store, fleet, description, seed) if rows else _write_logs(store, fleet, description, seed)
    columns = [(name, *column) for name, column in zip(fleet.names, fleet.columns, strict=True)]
    truth = [("robot", "joint", "kind", "change", "week"), *map(astuple, fleet.planted)]
    for name, table in (("machines.csv", [("robot", "cell", "lubricant_batch"), *columns]), ("truth.csv", truth)):
        store.put(f"_{name}" if rows else name, csv_text(table).encode())
        written.append(f"{out}/{'_' if rows else ''}{name}")
    return written


def _week(number: int) -> datetime:
    return _START + timedelta(weeks=number)


def _run(name: str, week: int) -> str:
    return f"{name}/{_week(week):%Y%m%dT%H%M%SZ}"


def _write_logs(store: Store, fleet: Fleet, robot: RobotDescription, seed: int) -> list[str]:
    still, rigid, friction = _motion(robot, seed)
    decay = (np.exp(-still.t / _DECAY) - 1)[:, None]
    for machine, name in enumerate(fleet.names):
        store.put(f"{name}/robot.yaml", _description(robot).encode())
        store.put(f"{name}/robot.urdf", robot.urdf.encode())
        for week in range(fleet.friction.shape[1]):
            rng = np.random.default_rng((seed, machine, week))
            cooling = 1 + fleet.answer[machine] * fleet.cold[machine, week] * decay
            torque = rigid + friction * fleet.friction[machine, week] * cooling
            log = replace(
                still,
                effort=torque + _NOISE * _nominal(robot) * rng.normal(size=torque.shape),
                position=still.position + 2e-6 * rng.normal(size=torque.shape),
                stamp=_week(week).timestamp(),
                metadata={"robot": robot.name, "motion": "excitation", "serial": name},
            )
            with TemporaryDirectory() as folder:
                write_log(Path(folder) / "excitation.mcap", log)
                store.put(f"{_run(name, week)}/excitation.mcap", Path(folder) / "excitation.mcap")
    return [store.url]


def _motion(robot: RobotDescription, seed: int) -> tuple[Log, np.ndarray, np.ndarray]:
    """The log of four sines a joint, the same for all machines, without noise; what torque (S, n) the bodies need, and
    friction. Within the joints' ranges, speeds and accelerations."""
    rng = np.random.default_rng((seed, 1))
    t = np.arange(round(_CYCLES * _PERIOD * _RATE)) / _RATE
    lower, upper = (np.clip(limit, -3.0, 3.0) for limit in robot.position_limits)
    omega = 2 * np.pi * np.arange(1, 5)[:, None] / _PERIOD
    phase = omega * t[:, None, None] + rng.uniform(0, 2 * np.pi, (4, robot.dof))
    size = rng.uniform(0.5, 1.0, (4, robot.dof)) / omega
    room = np.stack(
        [
            0.3 * (upper - lower) / size.sum(axis=0),
            0.6 * robot.max_velocity / (size * omega).sum(axis=0),
            0.6 * robot.max_acceleration / (size * omega**2).sum(axis=0),
        ]
    )
    size = size * room.min(axis=0)
    q = (lower + upper) / 2 + np.sum(size * np.sin(phase), axis=1)
    qd = np.sum(size * omega * np.cos(phase), axis=1)
    qdd = -np.sum(size * omega**2 * np.sin(phase), axis=1)
    rotors = np.array([1e-4 if joint.rotor_inertia is None else joint.rotor_inertia for joint in robot.joints])
    rigid = Dynamics(robot).inverse_dynamics(q, qd, qdd) + rotors * robot.gear_ratios**2 * qdd
    share = qd / robot.max_velocity
    log = Log(
        path=Path("excitation.mcap"),
        joint_names=robot.joint_names,
        t=t,
        position=q,
        velocity=None,
        effort=rigid,
        reference_position=None,
        planned_position=None,
        sample_rate=_RATE,
        stamp=0.0,
        segments=((0, len(t)),),
        cycle_starts=tuple(_PERIOD * k for k in range(_CYCLES)),
        metadata={},
    )
    return log, rigid, _nominal(robot) * (0.08 * np.tanh(share / _REVERSAL) + 0.08 * share)


def _nominal(robot: RobotDescription) -> np.ndarray:
    """(n,) nominal torque [N·m]; a guess where nobody knows it."""
    return np.where(np.isfinite(robot.nominal_torque), robot.nominal_torque, 100.0)


def _description(robot: RobotDescription) -> str:
    """A `robot.yaml` with its URDF in `robot.urdf` next to it."""
    keys = ("name", "gear_ratio", "nominal_motor_torque", "max_velocity", "max_acceleration", "rotor_inertia")
    joints = [{key: getattr(joint, key) for key in keys if getattr(joint, key) is not None} for joint in robot.joints]
    head = [f"name: {robot.name}", "urdf: robot.urdf", f"tip_frame: {robot.tip_frame}"]
    lines = [*head, f"gravity: {list(robot.gravity)}", "joints:"]
    lines += ["  - {" + ", ".join(f"{key}: {value}" for key, value in joint.items()) + "}" for joint in joints]
    lines += ["motor_coupling:", *(f"  - {[float(value) for value in row]}" for row in robot.motor_coupling)]
    return "\n".join(lines) + "\n"


def _write_rows(store: Store, fleet: Fleet, robot: RobotDescription, seed: int) -> list[str]:
    """The rows that `fleet estimate` would have made, as far as trends and the page look at them."""
    rng = np.random.default_rng((seed, 2))
    with TemporaryDirectory() as folder:
        path = Path(folder) / ROWS
        with pq.ParquetWriter(path, schema("estimate"), compression="zstd") as writer:
            for first in range(0, len(fleet.names), 50):
                writer.write_table(_rows(fleet, slice(first, first + 50), robot, rng))
        store.put(ROWS, path)
    return [f"{store.url}/{ROWS}"]


def _rows(fleet: Fleet, chosen: slice, robot: RobotDescription, rng: np.random.Generator) -> Any:
    """A table of some machines."""
    names, weeks, n, nominal = fleet.names[chosen], fleet.friction.shape[1], robot.dof, _nominal(robot)
    speeds = np.outer((0.15, 0.6), robot.max_velocity)
    factor = fleet.friction[chosen, :, None] * (1 + SCATTER * rng.normal(size=(len(names), weeks, 2, n)))
    values = factor * nominal * (0.08 + 0.08 * speeds / robot.max_velocity)
    rates = -fleet.answer[chosen, None] * fleet.cold[chosen, :, None] / _DECAY
    rates = rates + _DOUBT * rng.normal(size=rates.shape)
    errors = (0.003 + 2e-4 * rng.normal(size=rates.shape)) * nominal
    levels = [(axle, speed) for axle in range(n) for speed in range(2)]  # as `conditions` of a run has them
    rows = []
    for (machine, name), week in itertools.product(enumerate(names), range(weeks)):
        friction = [
            {
                "joint": robot.joint_names[axle],
                "speed": speeds[speed, axle],
                "value": (value := values[machine, week, speed, axle]),
                "standard_deviation": 0.01 * value,
                "from_run_to_run": SCATTER * value,
            }
            for axle, speed in levels
        ]
        row = {"robot": name, "run": _run(name, week), "status": "ok", "reason": "", "exit_code": 0}
        row |= {"started": _week(week), "serial": name, "logs": ["excitation.mcap"], "joints": robot.joint_names}
        row |= {"rmse": errors[machine, week], "normalised_rmse": errors[machine, week] / nominal}
        row |= {"nominal_torque": nominal, "friction": friction}
        row["warm_up"] = [{"rate_per_s": rate, "standard_deviation": _DOUBT} for rate in rates[machine, week]]
        rows.append(row)
    return pa.Table.from_pylist(rows, schema("estimate"))
