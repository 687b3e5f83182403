"""The simulator that a diagnosis was asked about, written back corrected."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Console, InputError
from agent.pipeline.identify import check_output

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis
    from agent.model import Simulator

_FORMATS = {".xml": "an MJCF", ".mjcf": "an MJCF", ".urdf": "a URDF"}


def check_simulator_out(model: Path | None, out: Path, inputs: Sequence[Path]) -> None:
    """Refuse a format that the simulator's file does not have, and files beside it that are inputs.

    Raises:
        InputError: as said.
    """
    from agent.model import written_files

    wanted = _FORMATS.get(out.suffix.lower())
    if wanted is None:
        return
    given = None if model is None else _FORMATS.get(model.suffix.lower())
    if given != wanted:
        raise InputError(
            f"{out}: {wanted} is written where --model is one, corrected in place; here it is "
            f"{given or ('none' if model is None else 'a model file')}: write a model file (-o model.json), from which "
            "agent export makes both"
        )
    for path in (*written_files(out), _ranges_file(out)):
        check_output(path, inputs)


def run_forward(found: Diagnosis, simulator: Simulator, console: Console) -> dict[str, Any]:
    """`forward` of a result: the simulator run as given and corrected; nothing where it cannot be."""
    from agent.diagnosis import forward_or_reason, forward_warning

    console.step("running the simulator forward, as given and corrected")
    figures, reason = forward_or_reason(found, simulator)
    if reason:
        console.warn(reason)
    if not figures:
        return {}
    warning = forward_warning(figures)
    if not warning:
        return {"forward": figures}
    console.warn(warning)
    return {"forward": figures, "warnings": [*found.result["warnings"], warning]}


def write_simulator(found: Diagnosis, simulator: Simulator, out: Path, console: Console) -> None:
    """Write the corrected simulator: in its own format with what stands beside it, or as a model file.

    Raises:
        InputError, RejectedError: the file cannot be changed in place, or did not read back as meant.
    """
    from agent.core import write_atomically
    from agent.diagnosis import corrected, ranges, ranges_text
    from agent.model import CATALOGUE, write_corrected

    correction = corrected(found, simulator)
    for note in correction.notes:
        console.warn(f"{out}: {note}")
    left_out = [cause.effect for cause in found.answer.causes if not CATALOGUE[cause.effect].of_the_arm]
    if left_out:
        console.warn(
            f"{out}: {' and '.join(left_out)} is left out, as no part of a simulator: it happens once, or in the "
            "set-points only"
        )
    if out.suffix.lower() not in _FORMATS:
        correction.model.save(out)
        return
    for path in write_corrected(simulator, correction, out):
        console.say(f"wrote {path}")
    write_atomically(_ranges_file(out), ranges_text(ranges(found)))
    console.say(f"wrote {_ranges_file(out)}")


def _ranges_file(out: Path) -> Path:
    return out.with_name(f"{out.stem}.ranges.yaml")
