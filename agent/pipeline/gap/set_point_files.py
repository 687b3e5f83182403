"""`agent plan ARM.xml`: a minute of set-points for an arm under position servos, as tables and for LeRobot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, InputError, write_atomically
from agent.diagnosis import Diagnosis, separations
from agent.excitation import (
    CHIRP,
    EXCITATIONS,
    REVERSALS,
    STEPS,
    SetPointMotion,
    SetPointPlan,
    excitation,
    plan_set_points,
)
from agent.recording import write_targets
from agent.runs import make_folder, write_json
from agent.simulators import Simulator, load_arm, load_simulator

_RATE = 100.0  # Hz of the tables
_FPS = 30  # frames a second of LeRobot's recorder where nobody says otherwise
_LEROBOT = "lerobot"
_TASK = "motion for system identification"
#: A kind alone has to add as much to the probability of the right answer, over all kinds together; and any motion.
_ALIKE, _HELPS = 0.02, 0.05
_TEXTS = {STEPS: "steps with rests", CHIRP: "a chirp to 3 Hz", REVERSALS: "slow reversals in several postures"}
_NO_MOTION = "no motion of the arm alone settles this:"
_OTHERWISE = "say what is known (--known kp), or weigh the load and put it into the file"


@dataclass(frozen=True, eq=False)
class SetPointFiles:
    """Output of the plan: its folder, the motions and what they reach in the simulation, and the files."""

    folder: Path
    plan: SetPointPlan
    files: tuple[str, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        plan = self.plan
        joints = {
            name: {
                "start": float(plan.limits.start[j]),
                "allowed": [float(plan.limits.low[j]), float(plan.limits.high[j])],
                "reached": plan.reached[:, j].tolist(),
                "fastest": float(plan.fastest[j]),
                "share_of_torque_limit": float(plan.torque[j]),
            }
            for j, name in enumerate(plan.joints)
        }
        return {
            "schema": "planned-set-points/1",
            "folder": str(self.folder),
            "rate_hz": _RATE,
            "motions": [
                {"name": motion.name, "kinds": list(motion.kinds), "duration_s": float(motion.time[-1])}
                for motion in plan.motions
            ],
            "joints": joints,
            "files": list(self.files),
        }

    def text(self) -> str:
        """A few lines for people."""
        plan = self.plan
        width = max(map(len, plan.joints))
        lines = [
            f"{len(plan.motions)} motions of {plan.motions[0].time[-1]:.0f} s: {', '.join(plan.motions[0].kinds)}",
            f"{'joint':{width}}  start  reaches          fastest  torque",
        ]
        for j, name in enumerate(plan.joints):
            low, high = plan.reached[:, j]
            torque = f"{100 * plan.torque[j]:3.0f} %" if np.isfinite(plan.torque[j]) and plan.torque[j] > 0 else "  -"
            lines.append(
                f"{name:{width}} {plan.limits.start[j]:6.2f}  {low:5.2f} to {high:5.2f}  {plan.fastest[j]:5.2f} /s  "
                f"{torque}"
            )
        return "\n".join([*lines, *self.notes, *(str(self.folder / name) for name in self.files)])


def plan_of_file(path: Path, folder: Path, console: Console, kinds: Sequence[str] = EXCITATIONS) -> SetPointFiles:
    """Plan a minute of set-points for the arm of an MJCF, and write them into a new folder. Opens no port.

    Args:
        path: of the MJCF.
        folder: that is made.
        console: told what is being done.
        kinds: of motion.

    Raises:
        InputError: a file without position servos, no motion that keeps all limits, or the folder holds a plan already.
        AgentError: the folder cannot be made.
    """
    simulator = servo_arm(path)
    console.step("simulating a minute of set-points")
    return write_set_points(plan_set_points(simulator, _RATE, kinds), folder)


def next_set_points(
    diagnosis: Diagnosis, simulator: Simulator | None, path: Path, folder: Path, console: Console
) -> dict[str, Any] | None:
    """Plan the set-points that separate what position logs leave open; returns `next_experiment` of the diagnosis.

    Tried are all kinds of motion together and each alone, for as long. Nothing is written where nothing helps.

    Raises:
        InputError: the logs have torque, or as `plan_of_file`.
    """
    if simulator is None or diagnosis.dataset.servos is None:
        raise InputError(f"diagnose: --next {path}: the logs have torque, so name a recipe (agent init)")
    console.step("weighing motions of set-points")
    limits, share = (plan := plan_set_points(servo_arm(path), _RATE)).limits, plan.share
    tried = {EXCITATIONS: "all of them", **{(kind,) * len(EXCITATIONS): kind for kind in EXCITATIONS}}
    motions = {name: excitation(limits, float(_FPS), share, kinds)[0] for kinds, name in tried.items()}
    pairs = separations(
        diagnosis, simulator, {name: (motion.time, motion.set_points) for name, motion in motions.items()}
    )
    if not pairs:
        console.warn(f"no effect or number is open, so nothing is written to {folder}")
        return None
    chance = {kinds: float(np.mean([pair.after[name] for pair in pairs])) for kinds, name in tried.items()}
    best = max(chance, key=lambda kinds: chance[kinds])
    best = EXCITATIONS if chance[EXCITATIONS] >= chance[best] - _ALIKE else best
    separates = sorted({name for pair in pairs for name in pair.names})
    if chance[best] < float(np.mean([pair.before for pair in pairs])) + _HELPS:
        return {"separates": separates, "motion": f"{_NO_MOTION} {_OTHERWISE}", "program": None}
    files = write_set_points(plan_set_points(servo_arm(path), _RATE, best), folder)
    motion = files.plan.motions[0]
    return {
        "separates": separates,
        "motion": f"{' and '.join(_TEXTS[kind] for kind in dict.fromkeys(best))}, {len(files.plan.motions)} times "
        f"{motion.time[-1]:.0f} s",
        "program": str(folder),
        "duration_s": float(sum(planned.time[-1] for planned in files.plan.motions)),
        "probability": [
            {
                "pair": [pair.cause, pair.rival],
                "before": pair.before,
                "after": pair.after[tried[best]],
                "after_if": [pair.after[tried[best]], None],
                "smallest_over_practical": None,
            }
            for pair in pairs
        ],
    }


def servo_arm(path: Path) -> Simulator:
    """The arm of an MJCF with position servos.

    Raises:
        InputError: a file that cannot be read, or without a position servo for each joint.
    """
    simulator = load_simulator(path, None, load_arm(path).joint_names)
    if isinstance(simulator.arm.servos, str):
        raise InputError(
            f"{path}: set-points are planned for an arm under position servos, and {simulator.arm.servos}. Give an "
            "MJCF with a position actuator (kp, kv, forcerange) on every joint, or a recipe (agent init)"
        )
    return simulator


def write_set_points(plan: SetPointPlan, folder: Path) -> SetPointFiles:
    """Write a plan: a table for each motion, all of them as a LeRobot dataset, and `plan.json`.

    Raises:
        InputError: the folder holds a plan already.
        AgentError: the folder cannot be made.
    """
    if (folder / "plan.json").exists():
        raise InputError(f"{folder}: holds a plan already; name another folder with -o, or move it away")
    make_folder(folder, "the plan")
    files = [f"{motion.name}.csv" for motion in plan.motions]
    for name, motion in zip(files, plan.motions, strict=True):
        write_atomically(folder / name, _table(plan.joints, motion))
    notes = ["Clear the surroundings of the arm and bring it to its start posture. Set-points are in rad or m."]
    try:
        frames = [
            excited.set_points for excited in excitation(plan.limits, float(_FPS), plan.share, plan.motions[0].kinds)
        ]
        ranges = np.stack(plan.limits.whole, axis=1)
        write_targets(folder / _LEROBOT, plan.joints, frames, _FPS, ranges, _TASK)
        files.append(_LEROBOT)
        notes.append(
            f"{_LEROBOT} is for lerobot-replay at {_FPS} frames a second, in degrees (use_degrees), grippers in percent"
        )
    except InputError as error:
        notes.append(f"no LeRobot dataset was written: {error}")
    written = SetPointFiles(folder, plan, (*files, "plan.json"), tuple(notes))
    write_json(folder / "plan.json", written.to_dict())
    return written


def _table(joints: Sequence[str], motion: SetPointMotion) -> str:
    rows = np.column_stack([motion.time, motion.set_points])
    lines = [",".join(("time", *joints)), *(",".join(f"{value:.6g}" for value in row) for row in rows)]
    return "\n".join(lines) + "\n"
