"""The simulator that a diagnosis compared with the robot: run forward, and written back corrected."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import Console, InputError, RejectedError, write_atomically
from agent.diagnosis import Diagnosis, forward_or_reason, forward_warning, ranges, ranges_text
from agent.model import CATALOGUE
from agent.runs import check_output
from agent.simulators import (
    TARGETS,
    Correction,
    Simulator,
    numbers_of_file,
    write_corrected,
    write_target,
    written_files,
)

_OVER_RANGE = 0.01  # rad or m, tolerated beyond the range of a joint
_FORMATS = {".xml": "an MJCF", ".mjcf": "an MJCF", ".urdf": "a URDF"}


def check_simulator_out(model: Path | None, out: Path, inputs: Sequence[Path]) -> None:
    """Refuse another format than the simulator's own, and files next to it that are inputs.

    Raises:
        InputError: as said.
    """
    wanted = _FORMATS.get(out.suffix.lower())
    if wanted is None:
        return
    file_format = None if model is None else _FORMATS.get(model.suffix.lower())
    if file_format != wanted:
        raise InputError(
            f"{out}: to write {wanted}, --model has to be one too; here it is "
            f"{file_format or ('none' if model is None else 'a model file')}. Write a model file (-o model.json) and "
            "convert it with agent export"
        )
    for path in (*written_files(out), _ranges_file(out)):
        check_output(path, inputs)


def run_forward(diagnosis: Diagnosis, simulator: Simulator, correction: Correction, console: Console) -> dict[str, Any]:
    """`ranges`, `forward` and `warnings` of a result: the simulator as given and corrected, where it can be run."""
    console.step("running the simulator forward, as given and corrected")
    figures, reason = forward_or_reason(diagnosis, simulator)
    warnings = [*beyond_range(diagnosis, simulator), *filter(None, [forward_warning(figures) if figures else ""])]
    for text in (*filter(None, [reason]), *warnings):
        console.warn(text)
    result: dict[str, Any] = {"ranges": [asdict(interval) for interval in ranges(diagnosis, correction)]}
    result |= {"forward": figures} if figures else {}
    return {**result, "warnings": [*diagnosis.result["warnings"], *warnings]} if warnings else result


def beyond_range(diagnosis: Diagnosis, simulator: Simulator) -> Iterator[str]:
    """Warn of joints that moved beyond their range in the file: a simulator that enforces it stops there."""
    arm = simulator.arm
    low, high = (end([end(log.position, axis=0) for log in diagnosis.dataset.logs], axis=0) for end in (np.min, np.max))
    lower, upper = arm.robot.position_limits
    beyond = np.maximum(lower - low, high - upper)
    for k in np.flatnonzero(beyond > _OVER_RANGE):
        unit = arm.robot.joints[k].position_unit
        yield (
            f"{arm.path.name}: {arm.joint_names[k]} moves from {low[k]:.3g} to {high[k]:.3g} {unit} in the logs, and "
            f"the file lets it move from {lower[k]:.3g} to {upper[k]:.3g}: widen its range there, or a "
            "simulator stops it; the roll-out is without ranges"
        )


def write_simulator(
    diagnosis: Diagnosis, simulator: Simulator, correction: Correction, out: Path, console: Console
) -> None:
    """Write the corrected simulator: in its own format with its companion files, or as a model file.

    Raises:
        InputError, RejectedError: the file cannot be edited, or did not read back as meant.
    """
    for note in correction.notes:
        console.warn(f"{out}: {note}")
    left_out = [cause.effect for cause in diagnosis.document.causes if not CATALOGUE[cause.effect].of_the_arm]
    if left_out:
        console.warn(
            f"{out}: {' and '.join(left_out)} is left out of the simulator: it is a single event, or in the "
            "set-points only"
        )
    if out.suffix.lower() not in _FORMATS:
        correction.model.save(out)
        return
    written = [*write_corrected(simulator, correction, out)]
    written.append(write_atomically(_ranges_file(out), ranges_text(ranges(diagnosis, correction))))
    for path in written:
        console.say(f"wrote {path}")
    folder = out.with_name(f"{out.stem}_for")
    try:
        numbers = numbers_of_file(out, simulator.arm.file_joints)
        for name in TARGETS:
            write_target(numbers, name, folder / name, lambda text: None)
        console.say(f"wrote {folder}: the same for {', '.join(TARGETS)}, with what each cannot say in left_out.json")
    except RejectedError as error:  # a file may have bodies that other simulators refuse
        console.warn(f"{folder}: no files for other simulators: {error}")


def _ranges_file(out: Path) -> Path:
    return out.with_name(f"{out.stem}.ranges.yaml")
