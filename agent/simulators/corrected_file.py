"""A corrected simulator written: the file that was given with only those values changed that should be.

Beside it stand `<name>.changes.json`, every change with its old value and the reason, and `<name>_effects.py`, what the
format cannot say. Nothing is written that was not read back and found to be the corrected arm.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import InputError, RejectedError
from agent.simulators.bodies import about_centre, seen_from
from agent.simulators.correction import Correction
from agent.simulators.effects_file import effects_text
from agent.simulators.load import Simulator, load_simulator
from agent.simulators.mjcf_text import MjcfText
from agent.simulators.servos import PositionServos
from agent.simulators.urdf_text import UrdfText

SCHEMA = "simulator-changes/1"
_TOLERANCE = 1e-8  # of the largest torque, between what is written and what was meant
_LEAST = 1e-12  # relative, that a number changes


@dataclass(frozen=True)
class FileChange:
    """One value of the file: of which element, its attribute, old and new value (SI), and why."""

    element: str
    attribute: str
    old: float | list[float]
    new: float | list[float]
    reason: str


def is_urdf(path: Path) -> bool:
    """Whether a file is, by its name, a URDF."""
    return path.suffix.lower() == ".urdf"


def written_files(out: Path) -> tuple[Path, Path]:
    """The files beside a corrected simulator: the changes, and the effects that it cannot say."""
    return out.with_name(f"{out.stem}.changes.json"), out.with_name(f"{_module(out.stem)}_effects.py")


def _module(stem: str) -> str:
    return "".join(letter if letter.isalnum() else "_" for letter in stem)


def write_corrected(simulator: Simulator, correction: Correction, out: Path) -> tuple[Path, ...]:
    """Write the corrected file and what stands beside it; returns all paths, the file first.

    Raises:
        InputError: the file cannot be changed in place (a body without a name, say).
        RejectedError: what was written does not read back as what was meant.
        AgentError: the disk is full or not writable.
    """
    from agent.core import write_atomically

    source = simulator.arm.path
    arm = simulator.arm
    text = UrdfText(arm, out) if is_urdf(source) else MjcfText(arm, out)
    changes = list(_changes(correction, text))
    if simulator.servos is not None and isinstance(text, MjcfText):
        changes += _servo_changes(correction, text)
    files = text.files()
    _read_back(correction, simulator, files, out)
    beside, effects = written_files(out)
    code = effects_text(correction, source.name, out.name)
    document = {
        "schema": SCHEMA,
        "from": {"file": source.name, "sha256": hashlib.sha256(source.read_bytes()).hexdigest()},
        "changes": [asdict(change) for change in changes],
        "effects": [asdict(entry) for entry in correction.effects],
        "effects_file": None if code is None else effects.name,
        "notes": list(correction.notes),
    }
    for path, content in files.items():
        write_atomically(path, content.decode("utf-8"))
    write_atomically(beside, json.dumps(document, indent=1, allow_nan=False))
    if code is not None:
        write_atomically(effects, code)
    return (*files, beside, *([] if code is None else [effects]))


def _changes(correction: Correction, text: MjcfText | UrdfText) -> Iterator[FileChange]:
    """Change the text, number by number, and say each."""
    before, after, released = correction.given, correction.arm, correction.released
    for k, joint in enumerate(before.file_joints):
        for key, reasons in (
            ("frictionloss", released.friction),
            ("damping", released.friction),
            ("armature", released.rotors),
        ):
            old, new = float(getattr(before, key)[k]), float(getattr(after, key)[k])
            if k in reasons and _differ(old, new) and text.is_supported(key):
                text.set_joint(k, joint, key, new)
                yield FileChange(f"joint {joint}", key, old, new, reasons[k])
        if k in released.springs:
            for key, old, new in (
                ("stiffness", before.stiffness[k], after.stiffness[k]),
                ("springref", before.rest[k], after.rest[k]),
            ):
                text.set_joint(k, joint, key, float(new))
                yield FileChange(f"joint {joint}", key, float(old), float(new), released.springs[k])
        if k in released.offsets:
            zeros = text.move_zero(k, joint, before.prismatic[k], released.offsets[k])
            yield FileChange(
                f"joint {joint}", text.zero, zeros[0], zeros[1], "encoder_offset: the joint's zero is elsewhere"
            )
        if k in released.links:
            body = after.carrying[k]
            old_block = seen_from(before.carrying[k].own, body.pose)
            new_block = seen_from(body.own, body.pose)
            text.set_inertial(joint, body.name, *about_centre(new_block))
            of = f"{'link' if is_urdf(before.path) else 'body'} {body.name or 'of ' + joint}"
            for key, part in (
                ("mass", slice(0, 1)),
                ("centre of mass", slice(1, 4)),
                ("inertia about it", slice(4, 10)),
            ):
                yield FileChange(of, key, _listed(old_block, part), _listed(new_block, part), released.links[k])
    if before.gravity != after.gravity:
        text.set_gravity(after.gravity)
        yield FileChange("option", "gravity", list(before.gravity), list(after.gravity), released.gravity)


def _servo_changes(correction: Correction, text: MjcfText) -> Iterator[FileChange]:
    """Other gains of servos; those damped by a ratio are written as they are, where masses change."""
    given, released = correction.given.servos, correction.released
    servos = correction.arm.servos
    assert isinstance(given, PositionServos)
    assert isinstance(servos, PositionServos)
    moved = text.damps_by_ratio and bool(released.links or released.rotors)
    for k, joint in enumerate(correction.given.file_joints):
        if k not in released.gains and not moved:
            continue
        (_, before), (gain, bias) = given.parameters(k), servos.parameters(k)
        text.set_servo(joint, gain, bias)
        if k in released.gains:
            yield FileChange(f"actuator of {joint}", "kp", -before[1], -bias[1], released.gains[k])
        if bias[2]:
            kept = "as it was: a dampratio would move it with the masses"
            yield FileChange(f"actuator of {joint}", "kv", -before[2], -bias[2], released.gains.get(k, kept))


def _listed(block: np.ndarray, part: slice) -> float | list[float]:
    """Mass, centre of mass or inertia about it (xx, xy, yy, xz, yz, zz) of a body, in its own frame."""
    if part.start == 0 or block[0] <= 0:
        return float(block[0]) if part.start == 0 else [0.0] * (part.stop - part.start)
    _, centre, inertia = about_centre(block)
    values = centre if part.start == 1 else inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return [float(value) for value in values]


def _differ(old: float, new: float) -> bool:
    return abs(new - old) > _LEAST * max(abs(old), abs(new))


def _read_back(correction: Correction, simulator: Simulator, files: dict[Path, bytes], out: Path) -> None:
    """Raise RejectedError unless the files read as the corrected arm."""
    names = dict(zip(simulator.arm.file_joints, simulator.arm.joint_names, strict=True))
    folder = Path(os.path.abspath(out)).parent
    trial: dict[Path, Path] = {}
    try:
        # beside the files to come, as what these refer to is found from there
        for path in files:
            handle, name = tempfile.mkstemp(prefix=".", suffix=path.suffix, dir=folder)
            os.close(handle)
            trial[path] = Path(name)
        for path, content in files.items():
            for other, place in trial.items():
                content = content.replace(f'"{other.name}"'.encode(), f'"{place.name}"'.encode())
            trial[path].write_bytes(content)
        try:
            read = load_simulator(trial[out], simulator.robot, correction.arm.joint_names, names).model
        except InputError as error:
            raise RejectedError(
                f"{out}: nothing was written: the corrected file is not accepted: {error}".replace(
                    trial[out].name, out.name
                )
            ) from None
    finally:
        for path in trial.values():
            path.unlink(missing_ok=True)
    # a URDF says no rotor inertia: those are the effects file's
    wanted = correction.model
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.uniform(-1, 1, (3, 50, wanted.robot.dof))
    expected = _without_rotors(wanted, q, qd, qdd) if is_urdf(simulator.arm.path) else _plain(wanted, q, qd, qdd)
    difference = float(np.abs(_plain(read, q, qd, qdd) - expected).max())
    if not difference <= _TOLERANCE * float(np.abs(expected).max()):
        raise RejectedError(
            f"{out}: nothing was written: the file as changed gives torques that differ by {difference:.3g} N·m from "
            "the corrected model's (something else in it scales or overrides inertias)"
        )


def _plain(model: Any, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    """Torque without friction, whose reversal no file has, and without effects."""
    return np.asarray(model.rigid.torque(q, qd, qdd, model.base_values))


def _without_rotors(model: Any, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
    return np.asarray(model.rigid.dynamics.inverse_dynamics(q, qd, qdd))
