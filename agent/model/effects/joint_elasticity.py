"""Two-mass resonance between motor and link."""

from __future__ import annotations

from agent.model.effects.effect import Numbers, near_one
from agent.model.effects.experiments import SHARP_REVERSALS
from agent.model.effects.two_mass import DAMPING, FREQUENCIES, TwoMass


class JointElasticity(TwoMass):
    """τ_k = −a (ṗ + s d), d the motor's lead over the link (see `two_mass`), a near 1: all joints feel the link."""

    name = "joint_elasticity"
    family = "transmission"
    usual = True
    formula = "−(ṗ + s d), p = M_kk ḋ, ṗ + c ḋ + k d = τ_link − s d, s = ∂τ_link / ∂q_k"
    source = "Spong, J. Dynamic Systems, Measurement and Control 109 (1987)"
    signature = "ringing after fast load changes, at one frequency that falls with the inertia carried"
    confused_with = ("time_delay", "backlash", "inertial_mismatch")
    phrase = "the gear gives way like a spring"
    look_at = "gear, belt and coupling of this joint: cracked, loose or undersized"
    shapes = ("twist",)
    experiment = SHARP_REVERSALS
    residual_driven = True
    refined = ("stiffness", "damping")
    grid = tuple((float(frequency), damping, 0.0) for frequency in FREQUENCIES for damping in DAMPING)
    few = grid[1::14]

    def plausible(self, settings: Numbers, values: Numbers) -> bool:
        return near_one(values["share"])
