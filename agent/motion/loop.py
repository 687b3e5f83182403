"""The excitation loop as moves."""

from __future__ import annotations

import numpy as np

from agent.motion.program import CartesianTarget, JointTarget, MotionSettings, Move, MoveType, Target


def loop_moves(poses: np.ndarray, settings: MotionSettings, joints: np.ndarray | None = None) -> tuple[Move, ...]:
    """One cycle over via-points (K, 4, 4): it starts at rest at the first, flies to the others and ends where it began.

    Every cycle ends with an exact stop, so that cycles repeat exactly. `settings` hold for all moves. A redundant arm
    needs the `joints` (K, n) at the via-points too: a pose would let it come back to its first point with other joints.
    """
    targets: list[Target] = (
        [CartesianTarget(pose) for pose in poses] if joints is None else [JointTarget(q) for q in joints]
    )
    flying = [
        Move(MoveType.LINEAR, target, settings, fly=True, name=f"p{k}") for k, target in enumerate(targets[1:], start=2)
    ]
    closing = settings.stopping()
    return (*flying, Move(MoveType.LINEAR, targets[0], closing, name="p1"))
