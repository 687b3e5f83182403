"""Inertial parameters of the bodies of a simulator's file: moved between frames, and the nearest that could exist.

Of one body (10,): mass, first moments, inertia about the origin of a frame, in the order of `LINK_PARAMETERS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.model.standard_parameters import LOG_DET_BASIS, from_pseudo_inertia, nearby_body, pseudo_inertia

_ROUNDS, _PULLS = 60, (1.0, 1e-2, 1e-4, 1e-6)  # Newton steps for each weight of the distance from the file
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
    T-RO 36, 2020), which has no end at bodies that could not exist. Newton's method, the distance weighing ever less
    (an interior-point method: Boyd and Vandenberghe, Convex Optimization, 11). `reach` [m] of the arm sizes a body that
    the file gives no extent.
    """
    mass = max(sum(max(block[0], 0.0) for block in blocks), 1e-3)
    bodies = [block if is_body(block) else nearby_body(block, 0.02 * mass, reach) for block in blocks]
    count = len(bodies)
    start = np.concatenate([*bodies, rotors])
    inverse = [np.linalg.inv(pseudo_inertia(block)) for block in bodies]
    slope = np.concatenate([*(np.einsum("kij,ji->k", LOG_DET_BASIS, s) for s in inverse), 1 / start[10 * count :]])
    hessian, linear = columns.T @ weight @ columns, columns.T @ weight @ target
    scale = 1 / np.sqrt(np.diag(_bend(start, count)))

    def value(unknown: np.ndarray, pull: float) -> float:
        return float((0.5 * hessian @ unknown - linear) @ unknown + pull * (slope @ unknown - _logs(unknown, count)))

    found = start
    for pull in _PULLS:
        for _ in range(_ROUNDS):
            gradient = hessian @ found - linear + pull * (slope - _pull(found, count))
            bend = (hessian + pull * _bend(found, count)) * np.outer(scale, scale)
            step = -scale * np.linalg.solve(bend, scale * gradient)
            share, now, falls = 1.0, value(found, pull), float(gradient @ step)
            while share > _STEP and not (
                _inside(found + share * step, count)
                and value(found + share * step, pull) <= now + 0.1 * share * falls + 1e-12 * abs(now)
            ):
                share *= 0.5
            if share <= _STEP:
                break
            found = found + share * step
            if np.linalg.norm(step / scale) < _STEP * np.linalg.norm(found / scale):
                break
    return found[: 10 * count].reshape(count, 10), found[10 * count :]


def _logs(unknown: np.ndarray, count: int) -> float:
    """Σ log det S + Σ log J."""
    bodies = unknown[: 10 * count].reshape(count, 10)
    return float(
        sum(np.linalg.slogdet(pseudo_inertia(block))[1] for block in bodies) + np.log(unknown[10 * count :]).sum()
    )


def _pull(unknown: np.ndarray, count: int) -> np.ndarray:
    """Gradient of Σ log det S + Σ log J."""
    inverse = [np.linalg.inv(pseudo_inertia(block)) for block in unknown[: 10 * count].reshape(count, 10)]
    return np.concatenate([*(np.einsum("kij,ji->k", LOG_DET_BASIS, s) for s in inverse), 1 / unknown[10 * count :]])


def _bend(unknown: np.ndarray, count: int) -> np.ndarray:
    """Hessian of −Σ log det S − Σ log J."""
    result = np.zeros((len(unknown), len(unknown)))
    for k, block in enumerate(unknown[: 10 * count].reshape(count, 10)):
        turned = np.linalg.inv(pseudo_inertia(block)) @ LOG_DET_BASIS
        here = slice(10 * k, 10 * k + 10)
        result[here, here] = np.einsum("aij,bji->ab", turned, turned)
    rest = np.arange(10 * count, len(unknown))
    result[rest, rest] = unknown[rest] ** -2
    return result


def _inside(unknown: np.ndarray, count: int) -> bool:
    return bool(np.all(unknown[10 * count :] > 0)) and all(
        is_body(block) for block in unknown[: 10 * count].reshape(count, 10)
    )
