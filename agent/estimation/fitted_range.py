"""The range of angles and speeds that a model was fitted on, and motions that leave it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from agent.estimation.observation import Observation
from agent.model import IdentifiedModel

_FASTER = 1.15  # times the highest speed of the fit: its friction there is a guess
_SLOW = 0.02  # of a joint's highest speed at all: up to that no motion is fast
_FURTHER = 0.25  # of the angles of the fit, beyond them: gravity is known there, what depends on the angle is not
_LEAST = 0.1  # rad or m; less further hardly matters
_OFTEN = 0.01  # of the samples


def fitted_range(observation: Observation) -> dict[str, Any]:
    """Of all rows of the fit and each joint: its lowest and highest position and its highest speed (SI), for a model's
    provenance."""
    motions = [segment.motion for segment in observation.segments]
    q = np.concatenate([motion.q[motion.kept] for motion in motions])
    qd = np.concatenate([motion.qd[motion.kept] for motion in motions])
    return {
        "lowest": q.min(axis=0).tolist(),
        "highest": q.max(axis=0).tolist(),
        "fastest": np.abs(qd).max(axis=0).tolist(),
    }


def known_positions(model: IdentifiedModel) -> tuple[np.ndarray, np.ndarray] | None:
    """(n,) lowest and highest positions [rad, m] that are still those of a model's fit; None where it does not say."""
    known = model.provenance.get("range")
    if known is None:
        return None
    lowest, highest = (np.array(known[key]) for key in ("lowest", "highest"))
    far = np.maximum(_FURTHER * (highest - lowest), _LEAST)
    return lowest - far, highest + far


def beyond_fit(model: IdentifiedModel, motions: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterator[str]:
    """What to know of motions, each positions and speeds (S, n) (SI), that leave the range of a model's fit for more
    than a moment; nothing where the model does not say what its fit was."""
    known = model.provenance.get("range")
    if known is None:
        return
    lowest, highest, fastest = (np.array(known[key]) for key in ("lowest", "highest", "fastest"))
    q, speed = np.concatenate([q for q, _ in motions]), np.abs(np.concatenate([qd for _, qd in motions]))
    units = ["m" if joint.prismatic else "rad" for joint in model.robot.joints]

    def of_joints(beyond: np.ndarray, text: Callable[[int], str]) -> str:
        often = np.flatnonzero(np.mean(beyond, axis=0) > _OFTEN).tolist()
        return "; ".join(f"{model.robot.joint_names[k]} {text(k)}" for k in often)

    faster = speed > np.maximum(_FASTER * fastest, _SLOW * model.robot.max_velocity)
    if said := of_joints(
        faster, lambda k: f"at up to {speed[:, k].max():.3g} {units[k]}/s, fitted up to {fastest[k]:.3g}"
    ):
        yield (
            f"these logs go faster than the motions that the model was fitted to ({said}): friction beyond that is a "
            "guess, and so is what differs there"
        )
    lower, upper = known_positions(model) or (lowest, highest)
    if said := of_joints(
        (q < lower) | (q > upper),
        lambda k: (
            f"between {q[:, k].min():.3g} and {q[:, k].max():.3g} {units[k]}, fitted between {lowest[k]:.3g} and "
            f"{highest[k]:.3g}"
        ),
    ):
        yield f"these logs go where the model was never fitted ({said}): treat results there with care"
