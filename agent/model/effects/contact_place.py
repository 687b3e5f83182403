"""Where on its link something pushed: the place that leaves least, together with the force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from agent.model.effects.contact_windows import PushedWindow
from agent.model.signals import MotionSignals

_ROUNDS = 30  # of force and place in turns
_WEAK = 1e-6  # of what is known of the rest: a place along the force turns no joint
_LARGE = 1 / 3  # of the arm's reach: so large is a link in any direction, if not longer


def place_of(push: PushedWindow, motions: Sequence[tuple[MotionSignals, np.ndarray, np.ndarray]]) -> np.ndarray | None:
    """(3,) [m] from the far end of a push's link, in the link's frame; None where that would be off the link.

    The torque J(p)ᵀ F of a force F at a place p of the link is linear in F for a place, and in p for a force; so each
    is fitted in turns (alternating least squares), which never leaves more. It starts at the far end.

    Args:
        motions: of every motion its signals, and the error and background (S', n) of the rows that are kept.
    """
    moments, side, farthest = np.zeros((12, 12)), np.zeros(12), 0.0
    for signals, residual, sigma in motions:
        time = signals.time[signals.kept]
        inside = (time >= push.start) & (time <= push.start + push.duration)
        if signals.log_index != push.log or not inside.any():
            continue
        rows = np.zeros(len(signals.time), dtype=bool)
        rows[signals.kept] = inside
        end = signals.pushed(push.link, rows)
        levers = [signals.pushed(push.link, rows, along) - end for along in np.eye(3)]
        columns = -np.concatenate([end, *levers], axis=1) / sigma[inside, None]
        moments += np.einsum("san,sbn->ab", columns, columns)
        side += np.einsum("san,sn->a", columns, (residual / sigma)[inside])
        farthest = max(signals.reference.links.link_lengths[push.link], _LARGE * signals.reference.reach)
    place = np.zeros(3)
    for _ in range(_ROUNDS):
        of_force = np.kron(np.append(1.0, place), np.eye(3)).T
        force = _solved(of_force.T @ moments @ of_force, of_force.T @ side)
        fixed = np.concatenate([force, np.zeros(9)])
        of_place = np.vstack([np.zeros((3, 3)), np.kron(np.eye(3), force[:, None])])
        place = _solved(of_place.T @ moments @ of_place, of_place.T @ (side - moments @ fixed))
    return place if np.linalg.norm(place) < farthest else None


def _solved(moments: np.ndarray, side: np.ndarray) -> np.ndarray:
    weak = (_WEAK * np.trace(moments) + 1e-12) * np.eye(len(side))
    return np.linalg.solve(moments + weak, side)
