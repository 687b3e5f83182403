"""Torque constants from a known mass at the flange, joint by joint.

Logs of the bare arm say what each joint's torque is, in the unit that the description's torque constants give. Where a
known mass is mounted, the torque that it adds is known in N·m. So of each joint alone

    τ_measured = φ(q, q̇, q̈) β + s τ_mass,    s = described constant / true constant,

with the model's columns φ and parameters β of the joint's own, over all logs; τ_mass is zero without the mass. Joints
with unlike errors share no parameters then. See M. Gautier, S. Briot, "Global identification of joint drive gains and
dynamic parameters of robots", J. Dynamic Systems, Measurement and Control 136 (2014).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from agent.estimation import FilterSettings, motions
from agent.model import IdentifiedModel, carrying, known_payload
from agent.recording import Log
from agent.validation.torque import filtered_columns

#: Parts of the logs that are left out in turn, for the uncertainty.
_PARTS = 20
#: Eigenvalues of normalised moments below this belong to parameters that the logs do not tell.
_TOLD = 1e-9


@dataclass(frozen=True)
class TorqueScale:
    """Measured over true torque of a joint's motor, with its 95 % interval, and the constant that would be right.

    constant, described [N·m/A], motor side; None where the description has none.
    """

    joint: str
    scale: float
    interval: float
    described: float | None

    @property
    def constant(self) -> float | None:
        """The torque constant that makes the known mass weigh what it does."""
        return None if self.described is None else self.described / self.scale

    @property
    def known(self) -> bool:
        """Whether the mass loads the joint enough to tell its scale from zero."""
        return 0.0 < self.interval < self.scale

    def text(self) -> str:
        """One line for people."""
        if not self.known:
            return f"{self.joint}: the known mass does not load it enough"
        line = f"{self.joint}: measures {self.scale:.3f} ± {self.interval:.3f} of the torque of the known mass"
        if self.constant is None or self.described is None:
            return line
        return f"{line}; torque_constant {self.constant:.4g} N·m/A, described {self.described:.4g}"


def torque_scales(model: IdentifiedModel, logs: Sequence[Log]) -> list[TorqueScale]:
    """By the least squares of the formula above, with the interval of a block jackknife.

    Args:
        model: its columns are used, and its filter.
        logs: of the bare arm, and with a known mass. Torque that couples several motors is taken at their axles.

    Raises:
        InputError: a log without torque, too short, or sampled too slowly for the cut-off.
    """
    at_axle = np.linalg.inv(np.array(model.robot.motor_coupling))
    moments: list[np.ndarray] = [np.zeros(())] * _PARTS  # each (n, p + 2, p + 2): columns, mass and measured torque
    for log in logs:
        payload = known_payload(log.metadata)
        loaded = model if payload is None else carrying(model, payload)
        for motion in motions(log, FilterSettings(model.cutoff, model.order)):
            states = motion.q, motion.qd, motion.qdd
            assert motion.torque is not None
            torques = motion.low_pass(np.hstack([loaded.predict(*states) - model.predict(*states), motion.torque]))
            torques = torques.reshape(len(torques), 2, -1).transpose(0, 2, 1)
            rows = np.concatenate([filtered_columns(model, motion), torques], axis=2)
            rows = at_axle.T @ rows
            for k, part in enumerate(np.array_split(rows, _PARTS)):
                moments[k] = moments[k] + np.einsum("sjp,sjr->jpr", part, part, optimize=True)
    total = np.sum(moments, axis=0)
    scale, without = _mass_terms(total), np.array([_mass_terms(total - part) for part in moments])
    interval = 1.96 * np.sqrt((_PARTS - 1) * np.mean((without - scale) ** 2, axis=0))
    return [
        TorqueScale(joint.name, float(factor), float(width), joint.torque_constant)
        for joint, factor, width in zip(model.robot.joints, scale, interval, strict=True)
    ]


def _mass_terms(moments: np.ndarray) -> np.ndarray:
    """(n,) coefficients of the known mass, from moments (n, p + 2, p + 2); parameters that nothing tells are zero."""
    size = np.sqrt(np.maximum(np.einsum("jpp->jp", moments), np.finfo(float).tiny))
    scaled = moments / (size[:, :, None] * size[:, None, :])
    solution = np.linalg.pinv(scaled[:, :-1, :-1], rcond=_TOLD, hermitian=True) @ scaled[:, :-1, -1:]
    return solution[:, -1, 0] * size[:, -1] / size[:, -2]
