"""Inertial parameters of the bodies of a simulator's file: moved between frames, and the nearest that could exist.

Of one body (10,): mass, first moments, inertia about the origin of a frame, in the order of `LINK_PARAMETERS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.model.standard_parameters import (
    from_pseudo_inertia,
    log_det_gradient,
    log_det_hessian,
    nearby_body,
    pseudo_inertia,
)
from agent.robot import ParameterLayout

_ROUNDS, _PULLS = 60, (1.0, 0.1)  # Newton steps for each weight of the distance from the file
_STEP = 1e-10  # relative, at which a minimum counts as found


@dataclass(frozen=True, eq=False)
class CarryingBody:
    """Of all bodies that a joint carries the one that takes a change of their inertia: the heaviest.

    `name` in the file, `pose` (4, 4) of its frame in the link's, `own` (10,) its parameters in the link's frame; `link`
    and `link_pose` are the same of the URDF that the arm is read as.
    """

    name: str
    pose: np.ndarray
    own: np.ndarray
    link: str
    link_pose: np.ndarray


def parameters(mass: float, centre: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """(10,) of a body, from mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about the centre, in one frame."""
    about = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.array([mass, *(mass * centre), *about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])


def about_centre(block: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about it: the inverse of `parameters`."""
    mass, moment = float(block[0]), block[1:4]
    xx, xy, yy, xz, yz, zz = block[4:]
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, moment / mass, about - (moment @ moment * np.eye(3) - np.outer(moment, moment)) / mass


def seen_from(block: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(10,) in the frame that lies at `pose` (4, 4): the 4 × 4 pseudo-inertia turns as T⁻¹ S T⁻ᵀ."""
    back = np.linalg.inv(pose)
    return from_pseudo_inertia(back @ pseudo_inertia(block) @ back.T)


def is_body(block: np.ndarray) -> bool:
    """Whether some mass distribution has these parameters."""
    matrix = pseudo_inertia(block)
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return bool(np.all(np.diag(matrix) > 0) and np.linalg.eigvalsh(matrix / np.outer(size, size))[0] > 1e-9)


def nearest(
    columns: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    blocks: Sequence[np.ndarray],
    rotors: Sequence[float] | np.ndarray,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Bodies (k, 10) and rotor inertias (m,) that could exist, with columns (b, 10 k + m) times them near target (b,).

    Near is by `weight` (b, b), the information of the logs; what these leave open is as near to the file's own `blocks`
    and `rotors` as can be, by relative entropy Σ tr(S₀⁻¹ S) − log det S + Σ J / J₀ − log J (Lee, Wensing and Park, IEEE
    T-RO 36, 2020), which has no end at bodies that could not exist. Newton's method, the distance weighing less and
    less (Boyd and Vandenberghe, Convex Optimization, 11), but never nothing: a link of tons would fit a little better.
    `reach` [m] of the arm sizes a body that the file gives no extent.
    """
    mass = max(sum(max(block[0], 0.0) for block in blocks), 1e-3)
    bodies = [block if is_body(block) else nearby_body(block, 0.02 * mass, reach) for block in blocks]
    layout = ParameterLayout(len(bodies), len(rotors))
    start = np.concatenate([*bodies, rotors])
    slope = log_det_gradient(start, layout)
    hessian, linear = columns.T @ weight @ columns, columns.T @ weight @ target
    scale = 1 / np.sqrt(np.diag(log_det_hessian(start, layout)))

    def value(unknown: np.ndarray, pull: float) -> float:
        return float((0.5 * hessian @ unknown - linear) @ unknown + pull * (slope @ unknown - _logs(unknown, layout)))

    found = start
    for pull in _PULLS:
        for _ in range(_ROUNDS):
            gradient = hessian @ found - linear + pull * (slope - log_det_gradient(found, layout))
            bend = (hessian + pull * log_det_hessian(found, layout)) * np.outer(scale, scale)
            step = -scale * np.linalg.solve(bend, scale * gradient)
            share, now, falls = 1.0, value(found, pull), float(gradient @ step)
            while share > _STEP and not (
                _inside(found + share * step, layout)
                and value(found + share * step, pull) <= now + 0.1 * share * falls + 1e-12 * abs(now)
            ):
                share *= 0.5
            if share <= _STEP:
                break
            found = found + share * step
            if np.linalg.norm(step / scale) < _STEP * np.linalg.norm(found / scale):
                break
    return layout.blocks(found), found[layout.rotors]


def _logs(unknown: np.ndarray, layout: ParameterLayout) -> float:
    """Σ log det S + Σ log J."""
    logs = [np.linalg.slogdet(pseudo_inertia(block))[1] for block in layout.blocks(unknown)]
    return float(sum(logs) + np.log(unknown[layout.rotors]).sum())


def _inside(unknown: np.ndarray, layout: ParameterLayout) -> bool:
    return bool(np.all(unknown[layout.rotors] > 0)) and all(map(is_body, layout.blocks(unknown)))
