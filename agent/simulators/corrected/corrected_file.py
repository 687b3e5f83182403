"""Writes a corrected simulator: the given file with only the corrected values changed.

Next to it go `<name>.changes.json`, every change with its old value and the reason, and `<name>_effects.py`, the
effects that the format cannot express. Everything is read back and compared with the corrected arm before writing.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from agent.core import InputError, RejectedError, sha256_file, write_atomically
from agent.model import FileNumbers, seen_from
from agent.robot import about_centre
from agent.simulators.arm import smooth_torque
from agent.simulators.corrected.correction import Correction
from agent.simulators.corrected.edits import MjcfEdits, UrdfEdits
from agent.simulators.corrected.effects_file import effects_text
from agent.simulators.loader import Simulator, load_simulator
from agent.simulators.servos import PositionServos

SCHEMA = "simulator-changes/1"
_TOLERANCE = 1e-8  # of the largest torque, between what is written and what was meant
_LEAST = 1e-12  # relative, that a number changes


#: One changed value: element, attribute, old and new value (SI), and the reason.
Change = dict[str, str | float | list[float]]


def written_files(out: Path) -> tuple[Path, Path]:
    """The files next to a corrected simulator: the changes, and the effects that its format cannot hold."""
    module = "".join(letter if letter.isalnum() else "_" for letter in out.stem)
    return out.with_name(f"{out.stem}.changes.json"), out.with_name(f"{module}_effects.py")


def write_corrected(simulator: Simulator, correction: Correction, out: Path) -> tuple[Path, ...]:
    """Write the corrected file and the files next to it; returns all paths, the corrected file first.

    Args:
        simulator: the file as given.
        correction: its moved numbers, and effects that no file holds.
        out: file to write.

    Raises:
        InputError: the file cannot be edited (for example, a body has no name).
        RejectedError: the written file does not read back as meant.
        AgentError: the disk is full or not writable.
    """
    source, arm = simulator.arm.path, simulator.arm
    edits = UrdfEdits(arm, out) if arm.is_urdf else MjcfEdits(arm, out)
    changes = list(_changes(correction, edits))
    if correction.released.gains and isinstance(edits, MjcfEdits):
        changes += _servo_changes(correction, edits)
    files = edits.files()
    _read_back(correction, simulator, files, out)
    changes_path, effects = written_files(out)
    code = effects_text(correction, source.name, out.name)
    document = {
        "schema": SCHEMA,
        "from": {"file": source.name, "sha256": sha256_file(source)},
        "changes": changes,
        "effects": [
            {**entry.to_dict(), "reason": correction.reasons.get((entry.effect, entry.joints), "")}
            for entry in correction.effects
        ],
        "effects_file": None if code is None else effects.name,
        "notes": list(correction.notes),
    }
    for path, content in files.items():
        write_atomically(path, content.decode("utf-8"))
    write_atomically(changes_path, json.dumps(document, indent=1, allow_nan=False))
    if code is not None:
        write_atomically(effects, code)
    return (*files, changes_path, *([] if code is None else [effects]))


def _changes(correction: Correction, edits: UrdfEdits | MjcfEdits) -> Iterator[Change]:
    """Change the file number by number and report each change."""
    before, after, released = correction.given, correction.arm, correction.released
    numbers = (
        ("frictionloss", before.frictionloss, after.frictionloss, released.friction),
        ("damping", before.damping, after.damping, released.friction),
        ("solimpfriction", before.impedance, after.impedance, released.holding),
        ("armature", before.armature, after.armature, released.rotors),
        ("stiffness", before.stiffness, after.stiffness, released.springs),
        ("springref", before.rest, after.rest, released.springs),
    )
    for k, joint in enumerate(before.file_joints):
        for key, was, becomes, reasons in numbers:
            old, new = float(was[k]), float(becomes[k])
            if k in reasons and key in edits.numbers and abs(new - old) > _LEAST * max(abs(old), abs(new)):
                edits.set_number(k, key, new)
                yield _change(f"joint {joint}", key, old, new, reasons[k])
        if k in released.offsets:
            old_zero, new_zero = edits.move_zero(k, released.offsets[k])
            why = "encoder_offset: the joint's zero is elsewhere"
            yield _change(f"joint {joint}", edits.zero, old_zero, new_zero, why)
        if k in released.links:
            body = after.carrying[k]
            blocks = [seen_from(entry.own, body.pose) for entry in (before.carrying[k], body)]
            edits.set_inertial(k, body.name, blocks[1])
            owner = f"{'link' if before.is_urdf else 'body'} {body.name or 'of ' + joint}"
            original, fixed = map(_inertia_numbers, blocks)
            for key in original:
                yield _change(owner, key, original[key], fixed[key], released.links[k])
    for pair in after.excluded:
        assert isinstance(edits, MjcfEdits)
        edits.exclude(pair)
        yield _change(
            " and ".join(pair), "exclude", 0.0, 1.0, "the bodies reach into each other where the arm was recorded"
        )
    if before.robot.gravity != after.robot.gravity:
        edits.set_gravity(after.robot.gravity)
        yield _change("option", "gravity", list(before.robot.gravity), list(after.robot.gravity), released.gravity)


def _change(element: str, attribute: str, old: float | list[float], new: float | list[float], reason: str) -> Change:
    return {"element": element, "attribute": attribute, "old": old, "new": new, "reason": reason}


def _servo_changes(correction: Correction, edits: MjcfEdits) -> Iterator[Change]:
    """Change gains, offsets and delays of servos. A damping ratio is written as a number where masses change."""
    original, released = correction.given.servos, correction.released
    servos = correction.arm.servos
    assert isinstance(original, PositionServos)
    assert isinstance(servos, PositionServos)
    moved = edits.damps_by_ratio and bool(released.links or released.rotors)
    for k, joint in enumerate(correction.given.file_joints):
        if k not in released.gains and not moved:
            continue
        (_, before), (gain, bias) = original.parameters(k), servos.parameters(k)
        edits.set_servo(k, gain, bias)
        if bias[1] != before[1]:
            yield _change(f"actuator of {joint}", "kp", -before[1], -bias[1], released.gains[k])
        if servos.offset[k] != original.offset[k]:
            reason, pair = released.gains[k], (float(original.offset[k]), float(servos.offset[k]))
            yield _change(f"actuator of {joint}", FileNumbers.OFFSET, *pair, reason)
        if servos.delay[k] != original.delay[k]:
            edits.set_delay(k, float(servos.delay[k]), original.step)
            yield _change(
                f"actuator of {joint}",
                "delay",
                float(original.delay[k]),
                float(servos.delay[k]),
                FileNumbers.DELAY,
            )
        if bias[2] and (moved or bias[2] != before[2]):
            unchanged = "as it was: a dampratio would move it with the masses"
            yield _change(f"actuator of {joint}", "kv", -before[2], -bias[2], released.gains.get(k, unchanged))


def _inertia_numbers(block: np.ndarray) -> dict[str, float | list[float]]:
    """Mass, centre of mass, and inertia about it (xx, xy, yy, xz, yz, zz) of a body (10,)."""
    heavy = block[0] > 0
    centre = block[1:4] / block[0] if heavy else np.zeros(3)
    inertia = about_centre(block) if heavy else np.zeros((3, 3))
    return {
        "mass": float(block[0]),
        "centre of mass": centre.tolist(),
        "inertia about it": inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]].tolist(),
    }


def _read_back(correction: Correction, simulator: Simulator, files: dict[Path, bytes], out: Path) -> None:
    """Raise RejectedError unless the files read as the corrected arm."""
    original, wanted = simulator.arm, correction.arm
    names = dict(zip(original.file_joints, original.joint_names, strict=True))
    trial: dict[Path, Path] = {}
    try:
        for path in files:  # in the folder of the output, because relative paths start there
            handle, name = tempfile.mkstemp(prefix=".", suffix=path.suffix, dir=out.absolute().parent)
            os.close(handle)
            trial[path] = Path(name)
        for path, content in files.items():
            for other, copy in trial.items():
                content = content.replace(f'"{other.name}"'.encode(), f'"{copy.name}"'.encode())
            trial[path].write_bytes(content)
        read = load_simulator(trial[out], simulator.robot, wanted.joint_names, names).arm
    except InputError as error:
        reason = str(error).replace(trial[out].name, out.name)
        raise RejectedError(f"{out}: nothing was written: the corrected file is not accepted: {reason}") from None
    finally:
        for path in trial.values():
            path.unlink(missing_ok=True)
    if original.is_urdf:  # which has neither: the effects file has them
        none = np.zeros(len(wanted.joint_names))
        wanted = replace(wanted, armature=none, stiffness=none)
    states = np.random.default_rng(0).uniform(-1, 1, (3, 50, len(wanted.joint_names)))
    expected, torque = (smooth_torque(arm, *states) for arm in (wanted, read))
    apart = np.abs(torque - expected).max(axis=0) + np.abs(read.frictionloss - wanted.frictionloss)
    most = float(np.abs(expected).max())
    if not np.all(apart <= _TOLERANCE * most):
        worst = int(np.argmax(apart))
        raise RejectedError(
            f"{out}: nothing was written: with the changes, the file gives {wanted.joint_names[worst]} torques that "
            f"differ by {apart[worst]:.3g} N·m from the corrected arm's, whose largest is {most:.3g} N·m (something "
            "else in it scales or overrides inertias)"
        )
