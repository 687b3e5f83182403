"""`… draw` prints the truth of runs, `… write` records one; both take an object on stdin, as JSON.

That of `draw` holds `count` and `seed`; that of `write` the `truth` of a run, a `folder` and the `seconds` of what a
person leads. A run is `arm.xml` and `logs/`: a LeRobot folder, or a table of each episode.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import needed
from agent.excitation import SetPointLimits, excitation
from fake_controller.actuation import load_effect
from fake_controller.servoed.arms import DrawnArm, draw_arm, with_factor
from fake_controller.servoed.cases import SERVO_FAULTS, draw_cases
from fake_controller.servoed.recording import Recorder, ServoFault, change_over_limit, reaches, record

_FASTEST = 2.0  # rad/s of a command
_NEAREST = 0.9  # of the largest lag behind the command, where commands are cut
_CLOSED = 1e-9  # rad of a gear whose play is closed: its steps are as fine, so jitter of the frames is the same


def main(arguments: Sequence[str]) -> int:
    """Returns the exit code."""
    job = json.load(sys.stdin)
    print(json.dumps(draw_cases(job["count"], job["seed"]) if arguments[0] == "draw" else write(job)))
    return 0


def write(job: Mapping[str, Any]) -> dict[str, Any]:
    """Write a run; returns the size of its effects and the numbers that the arm has."""
    truth, folder = job["truth"], Path(job["folder"])
    arm, seed, frames = draw_arm(truth["machine"]), truth["motion"], truth["frames"]
    targets = _targets(arm, truth["motions"], frames["rate"], job["seconds"], seed)
    recorder = Recorder(frames["rate"], frames["jitter"], np.inf, 0.0)
    plain = None
    if frames["clipped"] or truth["effects"]:
        closed = [{**e, "parameters": {"gap": _CLOSED}} for e in truth["effects"] if e["effect"] == "backlash"]
        plain = _recorded(arm, closed, targets, recorder, seed)
    if plain is not None and frames["clipped"]:
        lag = max(float(np.abs(r - q).max()) for r, q in zip(targets, plain, strict=True))
        recorder = replace(recorder, nearest=_NEAREST * lag)
    positions = _recorded(arm, truth["effects"], targets, recorder, seed)
    folder.mkdir(parents=True, exist_ok=True)
    file, real = _file_and_arm(arm, truth["effects"])
    (folder / "arm.xml").write_text(file.mjcf(), encoding="utf-8")
    (_lerobot if frames["format"] == "lerobot" else _tables)(folder / "logs", arm, frames["rate"], targets, positions)
    numbers = {name: values.tolist() for name, values in real.numbers.items()}
    numbers["delay_s"] = (np.array(numbers["delay_s"]) + _late(arm, truth["effects"])).tolist()
    size = None if not truth["effects"] or plain is None else change_over_limit(arm, positions, plain)
    return {"size": size, "numbers": numbers}


def _targets(arm: DrawnArm, motions: str, rate: float, seconds: float, seed: int) -> list[np.ndarray]:
    """Set-points (S, n) of two episodes: what is planned for the arm, or what a person leads it through."""
    rng = np.random.default_rng([seed, 23])
    low, high = arm.start - 0.9 * arm.half, arm.start + 0.9 * arm.half
    speed = np.minimum(0.5 * arm.limit / arm.numbers["damping"], _FASTEST)
    planned = [
        planned_motion.set_points for planned_motion in excitation(SetPointLimits(low, high, arm.start, speed), rate)
    ]
    led = [reaches(arm, rate, seconds, float(speed.min()), rng) for _ in planned]
    return {"planned": planned, "led": led, "both": [planned[0], led[1]]}[motions]


def _file_and_arm(arm: DrawnArm, effects: Sequence[Mapping[str, Any]]) -> tuple[DrawnArm, DrawnArm]:
    """The arm of the file, and the real one's servos and friction."""
    file = real = arm
    for effect in effects:
        parameters = effect["parameters"]
        if effect["effect"] == "torque_constant":
            real = with_factor(real, effect["joints"][0], kp=parameters["gain"])
        elif effect["effect"] == "torque_offset":
            real = with_factor(real, effect["joints"][0], offset=parameters["set_point_offset"])
        elif effect["effect"] == "friction_change" and parameters["missing"]:
            file = with_factor(file, effect["joints"][0], coulomb=0.0)
        elif effect["effect"] == "friction_change":
            real = with_factor(real, effect["joints"][0], coulomb=parameters["coulomb"])
    return file, real


def _late(arm: DrawnArm, effects: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """(n,) [s] by which commands arrive later than the file says, on all joints or on one."""
    late = np.zeros(len(arm.names))
    for effect in effects:
        if effect["effect"] == "time_delay":
            late[[arm.names.index(name) for name in effect["joints"] or arm.names]] += effect["parameters"]["delay"]
    return late


def _recorded(
    arm: DrawnArm, effects: Sequence[Mapping[str, Any]], targets: list[np.ndarray], recorder: Recorder, seed: int
) -> list[np.ndarray]:
    _, real = _file_and_arm(arm, effects)
    machine, fault, recorder = real.machine(), ServoFault(), replace(recorder, late=_late(arm, effects))
    for effect in effects:
        name, parameters = effect["effect"], effect["parameters"]
        if name in SERVO_FAULTS:
            of = arm.names.index(effect["joints"][0]) if effect["joints"] else 0
            fault = replace(fault, of=of, **parameters)
        elif name not in ("time_delay", "torque_constant", "torque_offset", "friction_change"):
            load_effect(effect).install(machine)
    return [record(real, machine, rows, recorder, fault, seed + k) for k, rows in enumerate(targets)]


def _lerobot(
    folder: Path, arm: DrawnArm, rate: float, targets: Sequence[np.ndarray], positions: Sequence[np.ndarray]
) -> None:
    """LeRobot's layout, version 2.1, in degrees: positions of hobby arms are (ticks - middle) · 360 / 4095."""
    arrow, parquet = needed("pyarrow", "a LeRobot dataset", "tables"), needed("pyarrow.parquet", "it", "tables")
    unit = 180 / np.pi * (4096 / 4095 if arm.kind.name == "hobby" else 1.0)
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    (folder / "meta").mkdir()
    names = [f"{name}.pos" for name in arm.names]
    vector = {"dtype": "float32", "shape": [len(names)], "names": names}
    about = {
        "codebase_version": "v2.1",
        "robot_type": "so101_follower" if arm.kind.name == "hobby" else "openarm_follower",
        "total_episodes": len(targets),
        "fps": int(rate),
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": {"observation.state": vector, "action": vector},
    }
    (folder / "meta" / "info.json").write_text(json.dumps(about), encoding="utf-8")
    for k, (r, q) in enumerate(zip(targets, positions, strict=True)):
        frame = np.arange(len(r))
        columns: dict[str, Any] = {
            name: arrow.FixedSizeListArray.from_arrays((unit * rows).astype(np.float32).ravel(), len(names))
            for name, rows in (("observation.state", q), ("action", r))
        }
        columns |= {"timestamp": (frame / rate).astype(np.float32), "frame_index": frame, "index": frame}
        columns["episode_index"] = np.full(len(frame), k)
        parquet.write_table(arrow.table(columns), data / f"episode_{k:06d}.parquet")


def _tables(
    folder: Path, arm: DrawnArm, rate: float, targets: Sequence[np.ndarray], positions: Sequence[np.ndarray]
) -> None:
    """Columns as Isaac Sim's system identification has them, in rad."""
    folder.mkdir(parents=True)
    numbers = range(1, len(arm.names) + 1)
    head = ",".join(["time", *(f"q{k}" for k in numbers), *(f"cmd{k}" for k in numbers)])
    for k, (r, q) in enumerate(zip(targets, positions, strict=True)):
        rows = np.column_stack([np.arange(len(r)) / rate, q, r])
        np.savetxt(folder / f"episode_{k}.csv", rows, "%.7g", ",", header=head, comments="")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
