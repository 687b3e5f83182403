"""Frames and Jacobian of a serial arm, and how far poses are from each other: the loops of `agent.robot.kinematics`."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.extending import intrinsic

from agent.compiled.compiling import compiled

_FUSED = get_host_cpu_features().get("fma", True)


def _product_added(_: Any, first: Any, other: Any, added: Any) -> Any:
    """one · other + added, rounded once where the processor can, which is what BLAS does."""

    def generate(_: Any, builder: Any, __: Any, values: Any) -> Any:
        return builder.fma(*values) if _FUSED else builder.fadd(builder.fmul(*values[:2]), values[2])

    return types.float64(types.float64, types.float64, types.float64), generate


_fused: Any = intrinsic(_product_added)


@compiled("Tuple((f8[:,:,::1], f8[:,:,::1]))(f8[:,:,::1], b1[::1], f8[:,::1], f8[:,::1], f8[:,::1])")
def forward_and_jacobian(  # noqa: C901
    transforms: np.ndarray, prismatic: np.ndarray, q: np.ndarray, cosine: np.ndarray, sine: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(S, 4, 4) poses and (S, 6, n) Jacobian of the TCP.

    Args:
        transforms: (n + 1, 4, 4) constant, between the joints, each made for a joint along its z axis.
        prismatic: (n,) bool.
        q: (S, n) joint positions.
        cosine: (S, n) of the positions.
        sine: (S, n) of the positions.
    """
    samples, joints = q.shape
    poses, jacobian = np.zeros((samples, 4, 4)), np.zeros((samples, 6, joints))
    frames, moved = np.empty((joints + 1, 4, 3)), np.empty((4, 3))
    for row in range(3):
        for column in range(4):
            frames[0, column, row] = transforms[0, row, column]
    for k in range(samples):
        for joint in range(joints):
            frame, transform = frames[joint], transforms[joint + 1]
            for row in range(3):
                x, y, z, origin = frame[0, row], frame[1, row], frame[2, row], frame[3, row]
                if prismatic[joint]:
                    moved[0, row], moved[1, row], moved[3, row] = x, y, z * q[k, joint] + origin
                else:
                    moved[0, row] = x * cosine[k, joint] + y * sine[k, joint]
                    moved[1, row] = y * cosine[k, joint] - x * sine[k, joint]
                    moved[3, row] = origin
                moved[2, row] = z
            for column in range(4):
                for row in range(3):
                    total = transform[0, column] * moved[0, row]
                    for part in range(1, 4):
                        total = _fused(transform[part, column], moved[part, row], total)
                    frames[joint + 1, column, row] = total
        tip = frames[joints]
        for row in range(3):
            for column in range(4):
                poses[k, row, column] = tip[column, row]
        poses[k, 3, 3] = 1.0
        for joint in range(joints):
            a0, a1, a2 = frames[joint, 2]
            if prismatic[joint]:
                jacobian[k, 0, joint], jacobian[k, 1, joint], jacobian[k, 2, joint] = a0, a1, a2
                continue
            o0, o1, o2 = frames[joint, 3]
            l0, l1, l2 = tip[3, 0] - o0, tip[3, 1] - o1, tip[3, 2] - o2
            jacobian[k, 0, joint] = a1 * l2 - a2 * l1
            jacobian[k, 1, joint] = a2 * l0 - a0 * l2
            jacobian[k, 2, joint] = a0 * l1 - a1 * l0
            jacobian[k, 3, joint], jacobian[k, 4, joint], jacobian[k, 5, joint] = a0, a1, a2
    return poses, jacobian


@compiled("Tuple((f8[:,::1], f8[:,::1]))(f8[:,:,:], f8[:,:,:])")
def pose_errors(target: np.ndarray, actual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of poses (S, 4, 4) (S, 6) the displacement and the axis times twice the sine of the turn, from actual to target;
    and (2, S) twice the turn's sine and cosine."""
    error, rotation_size = np.empty((len(target), 6)), np.empty((2, len(target)))
    rotation = np.empty((3, 3))
    for k in range(len(target)):
        for row in range(3):
            error[k, row] = target[k, row, 3] - actual[k, row, 3]
            for column in range(3):
                total = target[k, row, 0] * actual[k, column, 0]
                for part in range(1, 3):
                    total = _fused(target[k, row, part], actual[k, column, part], total)
                rotation[row, column] = total
        x = rotation[2, 1] - rotation[1, 2]
        y = rotation[0, 2] - rotation[2, 0]
        z = rotation[1, 0] - rotation[0, 1]
        error[k, 3], error[k, 4], error[k, 5] = x, y, z
        rotation_size[0, k] = np.sqrt(x * x + y * y + z * z)
        rotation_size[1, k] = rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1.0
    return error, rotation_size
