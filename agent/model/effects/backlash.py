"""Dead zone when the transmitted torque changes sign."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import Any

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import Columns, FitContext, Joints, Numbers, near_one
from agent.model.effects.experiments import SLOW_REVERSALS
from agent.model.effects.two_mass import DAMPING, FREQUENCIES, TwoMass

_GAPS = np.geomspace(2e-4, 1.3e-2, 11)  # rad
_READ = "read_behind"  # the setting of a servo that reads the link, behind the gear
#: Of such a servo: frequency [Hz], damping ratio, play [rad]. It hunts in the play or not by what a touch takes.
_BEHIND = tuple(product((20.0, 40.0), (0.04, 0.08, 0.16), np.geomspace(2e-3, 6e-2, 11).tolist()))
_FEW_BEHIND = _BEHIND[5::22]


class Backlash(TwoMass):
    """τ_k = −a ṗ, d the motor's lead over a link behind teeth with play (see `two_mass`), a near 1; elastic without.

    A position servo may read its link instead, as hobby servos do. The motor is then free in the play, and a servo may
    hunt there, so positions move by a times what a simulation of motor, teeth and link moves otherwise.
    """

    name = "backlash"
    family = "transmission"
    formula = "−(ṗ + s d), p = M_kk ḋ, ṗ + c ḋ + k z(d) = τ_link − s d, z = d beyond ± gap / 2"
    source = "Nordin, Gutman, Automatica 38 (2002)"
    signature = "pulses right after the load torque changes sign, quiet elsewhere"
    confused_with = ("presliding", "joint_elasticity")
    structurally_equivalent = ("joint_elasticity",)
    phrase = "the gear has play"
    look_at = "play of the gear: turn the link by hand with the motor braked"
    units = MappingProxyType({"gap": "rad"})
    leading = ("gap",)
    not_reported = (_READ,)
    needs_reversals = 2  # derived: one each way
    shapes = ("twist",)
    experiment = SLOW_REVERSALS
    why_absent = "no torque reversal in these logs"
    residual_driven = True
    refined = ("gap", "stiffness", "damping")
    grid = tuple((float(frequency), DAMPING[-1], float(gap)) for frequency in FREQUENCIES[::4] for gap in _GAPS)
    few = grid[1::28]

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        loads = np.concatenate([s.link_load[s.kept, joints[0]] for s in context.signals])
        if np.sum(np.diff(np.sign(loads)) != 0) < 2 * self.needs_reversals:
            return []
        tried = super().settings(context, joints)
        if tried and context.signals[0].through_play is not None:
            tried += self._read_behind(
                context, joints[0], len(self._on_single_joint(context)[joints[0]][0]) > len(self.few)
            )
        return tried

    def _read_behind(self, context: FitContext, k: int, suspect: bool) -> list[dict[str, float]]:
        """Of a servo that reads its link: the best of the grid, or of a few where the joint is not `suspect`."""
        inertia = float(np.mean([s.mass[:, k, k].mean() for s in context.signals]))
        tried = [
            {"stiffness": inertia * (2 * np.pi * frequency) ** 2, "damping": damping, "gap": gap, _READ: 1.0}
            for frequency, damping, gap in (_BEHIND if suspect else _FEW_BEHIND)
        ]
        made = [
            signals.remembered((_READ, k, suspect), partial(_moved, signals, k, tried)) for signals in context.signals
        ]
        return self._refined(context, k, tried, np.concatenate(made), _on_joint)

    def counted(self, settings: Numbers) -> int:
        return len(self.refined) if _READ in settings else super().counted(settings)

    def in_positions(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns | None:
        return {joints[0]: _moved(signals, joints[0], [settings])} if _READ in settings else None

    def prepare(self, motions: Sequence[MotionSignals], wanted: Sequence[tuple[Joints, Numbers]]) -> None:
        super().prepare(motions, [entry for entry in wanted if _READ not in entry[1]])

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        if _READ in settings:  # it is no torque of a joint
            return {joints[0]: np.zeros((len(signals.time), 1))}
        return super().columns(signals, joints, settings)

    def reported(self, reference: NominalModel, settings: Numbers, values: Numbers) -> dict[str, float]:
        return {**settings, **values} if _READ in settings else super().reported(reference, settings, values)

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        return None if _READ in values else super().stepped_parameters(values, inertia)

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(values["share"])


def _moved(signals: MotionSignals, k: int, tried: Sequence[Numbers]) -> np.ndarray:
    """(S', K) what positions show of play before what the servo of a joint reads."""
    assert signals.through_play is not None
    stiffness, gap, damping = (np.array([entry[name] for entry in tried]) for name in ("stiffness", "gap", "damping"))
    return signals.through_play(k, stiffness, gap, damping)


def _on_joint(context: FitContext, k: int, tried: Sequence[Numbers]) -> np.ndarray:
    return np.concatenate([_moved(signals, k, tried) for signals in context.signals])
