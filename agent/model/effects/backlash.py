"""Dead zone when the transmitted torque changes sign."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from agent.model.effects.effect import FitContext, Joints, Numbers, near_one
from agent.model.effects.experiments import SLOW_REVERSALS
from agent.model.effects.two_mass import DAMPING, FREQUENCIES, TwoMass

_GAPS = np.geomspace(2e-4, 1.3e-2, 11)  # rad


class Backlash(TwoMass):
    """τ_k = −a ṗ, d the motor's lead over a link behind teeth with play (see `two_mass`), a near 1; elastic without."""

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
    needs_reversals = 2
    shapes = ("twist",)
    experiment = SLOW_REVERSALS
    why_absent = "no torque reversal in these logs"
    residual_driven = True
    refined = ("gap", "stiffness", "damping")
    grid = tuple((float(frequency), DAMPING[-1], float(gap)) for frequency in FREQUENCIES[::4] for gap in _GAPS)
    few = grid[1::28]

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        loads = np.concatenate([s.link_load[s.kept, joints[0]] for s in context.signals])
        return (
            super().settings(context, joints)
            if np.sum(np.diff(np.sign(loads)) != 0) >= 2 * self.needs_reversals
            else []
        )

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(values["share"])
