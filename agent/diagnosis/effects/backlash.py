"""Dead zone when the transmitted torque changes sign."""

import numpy as np

from agent.diagnosis.effects.effect import Effect
from agent.diagnosis.effects.two_mass import twist_acceleration

_GAPS = (2e-4, 6e-4, 2e-3, 6e-3)  # rad
_FREQUENCY = 45.0  # Hz, of the link on its locked motor while the teeth touch
_DAMPING = 0.15


class Backlash(Effect):
    """τ = −a M(q)[:, k] d̈, d the motor's lead over a link behind teeth with play (see `two_mass`), a near 1."""

    name = "backlash"
    formula = "−M(q)[:, k] · d̈, M_kk d̈ + c ḋ + k z(d) = τ_link, z = d beyond ± gap / 2"
    source = "Nordin, Gutman, Automatica 38 (2002)"
    signature = "pulses right after the load torque changes sign, quiet elsewhere"
    confused_with = ("presliding", "joint_elasticity")
    look_at = "play of the gear: turn the link by hand with the motor braked"
    refined = ("gap",)

    def settings(self, survey, joints):
        (k,) = joints
        loads = np.concatenate([s.link_load[s.kept, k] for s in survey.signals])
        if np.sum(np.diff(np.sign(loads)) != 0) < 4:
            return []
        inertia = float(np.mean([s.mass[:, k, k].mean() for s in survey.signals]))
        return [{"gap": gap, "stiffness": inertia * (2 * np.pi * _FREQUENCY) ** 2} for gap in _GAPS]

    def names(self, settings):
        return ("share",)

    def prepare(self, signals, wanted):
        known = signals.__dict__.setdefault("_backlash", {})
        keys = ((joints[0], s["stiffness"], s["gap"]) for joints, s in wanted)
        new = [key for key in keys if key not in known]
        if new:
            joints, stiffness, gap = (np.array(part) for part in zip(*new, strict=True))
            known.update(zip(new, twist_acceleration(signals, joints, stiffness, gap, _DAMPING).T, strict=True))

    def columns(self, signals, joints, settings):
        (k,) = joints
        self.prepare(signals, [(joints, settings)])
        lead = signals.__dict__["_backlash"][k, settings["stiffness"], settings["gap"]]
        return {j: -(signals.mass[:, j, k] * lead)[:, None] for j in range(signals.q.shape[1])}

    def plausible(self, settings, values):
        return 0.15 < values["share"] < 4.0

    def freedom(self, settings):
        return 2
