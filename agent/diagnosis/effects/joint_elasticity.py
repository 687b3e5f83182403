"""Two-mass resonance between motor and link."""

import numpy as np

from agent.diagnosis.effects.effect import Effect
from agent.diagnosis.effects.two_mass import twist_acceleration

_FREQUENCIES = (3.5, 4.2, 5.1, 6.2, 7.5, 9.0, 11.0, 13.5, 17.0, 22.0, 30.0)  # Hz, of the link on its locked motor
_DAMPING = 0.05


class JointElasticity(Effect):
    """τ = −a M(q)[:, k] d̈, d the motor's lead over the link (see `two_mass`), a near 1: all joints feel the link."""

    name = "joint_elasticity"
    formula = "−M(q)[:, k] · d̈, M_kk d̈ + c ḋ + k d = τ_link"
    source = "Spong, J. Dynamic Systems, Measurement and Control 109 (1987)"
    signature = "ringing after fast load changes, at one frequency that falls with the inertia carried"
    confused_with = ("time_delay", "backlash", "inertial_mismatch")
    look_at = "gear, belt and coupling of this joint: cracked, loose or undersized"
    refined = ("stiffness",)

    def settings(self, survey, joints):
        (k,) = joints
        inertia = float(np.mean([s.mass[:, k, k].mean() for s in survey.signals]))
        return [{"stiffness": inertia * (2 * np.pi * f) ** 2} for f in _FREQUENCIES]

    def names(self, settings):
        return ("share",)

    def prepare(self, signals, wanted):
        known = signals.__dict__.setdefault("_elastic", {})
        new = [key for key in ((joints[0], s["stiffness"]) for joints, s in wanted) if key not in known]
        if new:
            joints, stiffness = (np.array(part) for part in zip(*new, strict=True))
            leads = twist_acceleration(signals, joints, stiffness, np.zeros(len(new)), _DAMPING)
            known.update(zip(new, leads.T, strict=True))

    def columns(self, signals, joints, settings):
        (k,) = joints
        self.prepare(signals, [(joints, settings)])
        lead = signals.__dict__["_elastic"][k, settings["stiffness"]]
        return {j: -(signals.mass[:, j, k] * lead)[:, None] for j in range(signals.q.shape[1])}

    def plausible(self, settings, values):
        return 0.3 < values["share"] < 2.5

    def freedom(self, settings):
        return 2
