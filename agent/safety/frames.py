"""The controller's frames, where what a program means depends on them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from agent.core import ControllerError, InputError
from agent.safety.motion import PlannedProgram
from drivers.protocol import Driver, ReportsFrames

#: Frames this near are the same [m, and of the rotation's entries]: what a four-byte number keeps of millimetres.
SAME_FRAME = 1e-5


def check_frames(program: PlannedProgram, driver: Driver, address: str) -> None:
    """The controller has the frames that the plan takes for granted.

    Raises:
        ControllerError: it has others; the message names both.
        InputError: the program leaves them open, and this link cannot read them.
    """
    if not program.frames:
        return
    found = driver.frames() if isinstance(driver, ReportsFrames) else {}
    if not program.frames.keys() <= found.keys():
        missing = " and ".join(program.frames)
        lines = "; ".join(f"{name} := {pos_text(frame)}" for name, frame in program.frames.items())
        raise InputError(
            f"{address}: program {program.name} does not set {missing}, so its way depends on what ran before it, "
            f"and this link cannot read that. Set it before the first move; the plan was made for {lines}"
        )
    wrong = [
        f"{name} is {pos_text(found[name])}, the plan is for {pos_text(frame)}"
        for name, frame in program.frames.items()
        if not np.abs(found[name] - frame).max() <= SAME_FRAME
    ]
    if wrong:
        raise ControllerError(
            f"{address}: not ready to move: at the controller {'; '.join(wrong)}. Set it there, or change the recipe's "
            "tool; then run the command again"
        )


def pos_text(frame: np.ndarray) -> str:
    """A frame (4, 4) [m] as PDL2 has it, in mm and degrees."""
    from agent.motion import pose_to_pos

    fields = pose_to_pos(frame).round(3) + 0.0
    return f"POS({', '.join(f'{value:g}' for value in fields)}, '')"


def frames_text(frames: Mapping[str, np.ndarray]) -> str:
    """All of them, for a person."""
    return ", ".join(f"{name} {pos_text(frame)}" for name, frame in frames.items())
