"""Effects that a simulator's file cannot express: torque of the robot's drives beyond the simulator's own.

Pure NumPy. `Effects.torque` takes one step of one arm, or of many at once (any leading shape), and returns what the
motors have to give more, (..., n) [N·m]: a simulator applies the opposite to its joints. `Effects.reading` turns the
torque that motors give into what the robot reports. In MuJoCo:

    import mujoco
    model = mujoco.MjModel.from_xml_path("arm.xml")
    effects = install(mujoco, model)  # from here on every mj_step has them

Positions, speeds and accelerations are of the joints in the order of JOINTS, SI.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# data
JOINTS: tuple[str, ...] = ()
REVERSAL: tuple[float, ...] = ()  # rad/s over which friction changes sign, as tanh(speed / REVERSAL)
ROTORS: tuple[float, ...] = ()  # kg·m² at the joint, part of the load on a gear
ARMATURE: tuple[float, ...] = ()  # kg·m² at the joint that the file cannot say: give it to the simulator, or `qdd` here
COULOMB: tuple[float, ...] = ()  # N·m, of the file
VISCOUS: tuple[float, ...] = ()  # N·m·s/rad, of the file
EFFECTS: tuple[dict[str, Any], ...] = ()
# end of data

Array = np.ndarray[Any, np.dtype[np.float64]]


class Effects:
    """The effects of arms of leading `shape`, stepped every `dt` [s]; `reset` starts again at time 0, stationary."""

    def __init__(self, shape: tuple[int, ...] = (), dt: float = 0.002):
        self.shape, self.dt = shape, dt
        self.reversal, self.armature = np.array(REVERSAL), np.array(ARMATURE)
        self.reset()

    def reset(self, time: float = 0.0) -> None:
        """Forget all motion."""
        self.time = time
        self._states: dict[int, dict[str, Any]] = {}
        self._past: list[Array] = []

    def torque(
        self,
        q: Array,
        qd: Array,
        qdd: Array | None = None,
        load: Array | None = None,
        mass: Array | None = None,
        slope: Array | None = None,
    ) -> Array:
        """(..., n) [N·m] that the motors give beyond the simulator's, at q, qd, qdd (..., n); then time goes on.

        `load` (..., n) [N·m] is the inverse dynamics of the bodies alone, without rotors and friction, `slope`
        (..., n, n) [N·m/rad] how it changes with the position of each joint (columns), and `mass` (..., n, n) their
        mass matrix. What is not given counts as zero (the mass matrix as one).
        """
        q, qd = np.asarray(q, dtype=float), np.asarray(qd, dtype=float)
        qdd = np.zeros_like(q) if qdd is None else np.asarray(qdd, dtype=float)
        load = np.zeros_like(q) if load is None else np.asarray(load, dtype=float)
        total = qdd * self.armature
        for number, effect in enumerate(EFFECTS):
            state = self._states.setdefault(number, {})
            j, p, form = list(effect["joints"]), effect["parameters"], getattr(self, f"_{effect['form']}")
            if effect["form"].startswith("arm_"):
                total = total + form(state, j, p, qd, qdd, load, mass, slope)
            elif effect["form"].startswith("joint_"):
                total[..., j[0]] += form(state, j[0], p, q[..., j[0]], qd[..., j[0]], load[..., j[0]], qdd[..., j[0]])
                if "reversal_travel" in p:
                    bristles = self._dahl(state.setdefault("bristles", {}), q[..., j[0]], p["reversal_travel"])
                    total[..., j[0]] += p["reversal_level"] * (bristles - self._slide(j[0], qd[..., j[0]]))
        self.time += self.dt
        return total

    def reading(self, torque: Array) -> Array:
        """(..., n) [N·m] what the robot reports while its motors give `torque` (..., n); once a step."""
        torque = np.asarray(torque, dtype=float)
        measured = torque.copy()
        for effect in EFFECTS:
            if effect["form"].startswith("reading_"):
                measured += getattr(self, f"_{effect['form']}")(effect["joints"], effect["parameters"], torque)
        return measured

    def _reading_scaled(self, joints: Any, p: Any, torque: Array) -> Array:
        more = np.zeros_like(torque)
        more[..., joints[0]] = p["scale_error"] * torque[..., joints[0]]
        return more

    def _reading_shifted(self, joints: Any, p: Any, torque: Array) -> Array:
        more = np.zeros_like(torque)
        more[..., joints[0]] = p["offset"]
        return more

    def _reading_late(self, joints: Any, p: Any, torque: Array) -> Array:
        back = p["delay"] / self.dt
        whole = int(back)
        self._past = [torque, *self._past][: whole + 2]
        newer, older = (self._past[min(k, len(self._past) - 1)] for k in (whole, whole + 1))
        return np.asarray(p["share"] * ((1 - back + whole) * newer + (back - whole) * older - torque))

    def _slide(self, joint: int, qd: Array) -> Array:
        return np.tanh(qd / self.reversal[joint])

    def _dahl(self, state: dict[str, Array], q: Array, travel: float) -> Array:
        """Presliding: ds = (1 − s sign(dx)) dx / travel (Dahl, 1976), exact over a step."""
        step = q - state.get("q", q)
        decay = np.exp(-np.abs(step) / travel)
        state["s"] = decay * state.get("s", np.zeros_like(q)) + np.sign(step) * (1 - decay)
        state["q"] = q
        return state["s"]

    def _joint_stribeck(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        fading = np.minimum((np.abs(qd) / p["speed"]) ** p["shape"], 700)
        return p["rise"] * self._slide(j, qd) * np.exp(-fading)

    def _joint_friction_change(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        return p.get("coulomb_change", 0.0) * self._slide(j, qd) + p.get("viscous_change", 0.0) * qd

    def _joint_asymmetric_friction(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        slide = np.abs(self._slide(j, qd))
        return p.get("coulomb_asymmetry", 0.0) * slide + p.get("viscous_asymmetry", 0.0) * np.abs(qd)

    def _joint_load_dependent_friction(
        self, state: Any, j: int, p: Any, q: Array, qd: Array, load: Array, qdd: Array
    ) -> Array:
        load, nominal = load + ROTORS[j] * qdd, p.get("load", 1.0)
        torque = p["coefficient"] * self._slide(j, qd) * nominal * (np.abs(load) / nominal) ** p.get("power", 1.0)
        return torque + p.get("sheared_coefficient", 0.0) * qd * np.abs(load) + p.get("driven_coefficient", 0.0) * load

    def _joint_viscous_nonlinearity(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        power = p.get("power", 1.0)
        bent = p["speed"] * np.arcsinh(qd / p["speed"]) if "speed" in p else np.sign(qd) * np.abs(qd) ** power
        return p["bend"] * bent + p["viscous_change"] * qd

    def _joint_thermal_friction(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        if "way" in p:
            state["gone"] = state.get("gone", np.zeros_like(q)) + np.abs(q - state.get("q", q))
            state["q"] = q
            cold = np.exp(-state["gone"] / p["way"])
        else:
            cold = np.exp(-self.time / p["time_constant"])
        coulomb = p["coulomb_change"] + p["coulomb_drift"] * cold
        return coulomb * self._slide(j, qd) + (p["viscous_change"] + p["viscous_drift"] * cold) * qd

    def _joint_presliding(self, state: Any, j: int, p: Any, q: Array, qd: Array, *_: Array) -> Array:
        return p["level"] * (self._dahl(state, q, p["travel"]) - self._slide(j, qd))

    def _joint_torque_ripple(self, state: Any, j: int, p: Any, q: Array, *_: Array) -> Array:
        return _harmonics(p, p["order"] * q)

    def _joint_gravity_spring(self, state: Any, j: int, p: Any, q: Array, *_: Array) -> Array:
        return _harmonics(p, q) if "harmonics" in p else p["constant"] + p["stiffness"] * q

    def _joint_dress_pack(self, state: Any, j: int, p: Any, q: Array, *_: Array) -> Array:
        if "curve" in p:
            nodes, powers = np.array(p["nodes"]), np.array(p["curve"])  # torque per power of the way from a node
            inside = np.clip(q, nodes[0], nodes[-1])
            piece = np.clip(np.searchsorted(nodes, inside, side="right") - 1, 0, len(nodes) - 2)
            offset = inside - nodes[piece]
            torque = sum(powers[k][piece] * offset**k for k in range(4))
            slope = sum(k * powers[k][piece] * offset ** (k - 1) for k in range(1, 4))
            torque = torque + slope * (q - inside)
        else:
            x = q - p.get("middle", 0.0)
            torque = p["constant"] + (p["stiffness"] + (p.get("quadratic", 0.0) + p.get("cubic", 0.0) * x) * x) * x
        if "travel" in p:
            torque = torque + p["hysteresis"] * self._dahl(state, q, p["travel"])
        return np.asarray(torque)

    def _arm_two_mass(
        self,
        state: dict[str, Any],
        joints: Any,
        p: Any,
        qd: Array,
        qdd: Array,
        load: Array,
        mass: Array | None,
        slope: Array | None,
    ) -> Array:
        """Motor ahead of its link by d: ṗ + c ḋ + k z(d) = load − slope d, p = m ḋ; semi-implicit steps of 1/1500 s at
        most. How the link rings at the start is not known: it is forgotten with the fourth power of the time gone."""
        (j,) = joints
        empty = np.zeros((*load.shape, len(JOINTS)))
        matrix = empty + np.eye(len(JOINTS)) if mass is None else np.asarray(mass)
        falls = empty[..., j] if slope is None else np.asarray(slope)[..., :, j]
        inertia, k, half = np.maximum(matrix[..., j, j], 1e-9), p["stiffness"], 0.5 * p.get("gap", 0.0)
        torque, fallen = load[..., j], np.clip(falls[..., j], -0.5 * k, 0.5 * k)
        twist = state.get("twist", torque / k + np.sign(torque) * half)
        momentum = before = state.get("momentum", np.zeros_like(torque))
        state["steps"] = state.get("steps", 0) + 1
        steps = max(2, int(np.ceil(1500.0 * self.dt)))
        h = self.dt / steps
        forgetting = np.minimum(2 * h * np.sqrt(k / inertia), 8 * h / (state["steps"] * self.dt))
        kept_touching = 1 - np.minimum(np.maximum(h * p["damper"] / inertia, forgetting), 1)
        for _ in range(steps):
            beyond = twist - np.clip(twist, -half, half)
            decay = np.where((beyond != 0) | (half == 0), kept_touching, 1.0)
            momentum = decay * momentum + h * torque - h * fallen * twist - h * k * beyond
            twist = twist + h * momentum / inertia
        speed = momentum / inertia
        second = (speed - state.get("speed", np.zeros_like(speed))) / self.dt
        state.update(twist=twist, momentum=momentum, speed=speed)
        felt = -p["share"] * (matrix[..., :, j] * second[..., None] + falls * twist[..., None])
        felt[..., j] = -p["share"] * ((momentum - before) / self.dt + fallen * twist)
        return felt

    def _arm_coupled(self, state: Any, joints: Any, p: Any, qd: Array, qdd: Array, load: Array, *_: Any) -> Array:
        """Axle j turns along with joint i by a ratio: rotor, friction and load act on both."""
        (i, j), ratio, free = joints, p["ratio"], "free" in p
        speed = qd[..., j] + ratio * qd[..., i]

        def friction(w: Array) -> Array:
            if free:
                return p["viscous"] * w + p["coulomb"] * self._slide(j, w)
            return np.asarray(p["share"] * (COULOMB[j] * self._slide(j, w) + VISCOUS[j] * w))

        felt = np.zeros_like(qd)
        if "besides" in p:
            rubbing = p["viscous"] * speed + p["coulomb"] * self._slide(j, speed)
            if "shaft" in p:
                rubbing = rubbing + p["inertia"] * (qdd[..., j] + ratio * qdd[..., i])
            felt[..., j], felt[..., i] = rubbing, ratio * rubbing
            if "turning" in p:
                tied = {"ratio": ratio, "rotor": p["rotor"], "share": p["share"]}
                felt = felt + self._arm_coupled(state, joints, tied, qd, qdd, load)
            return felt
        felt[..., j] = p["rotor"] * ratio * qdd[..., i] + friction(speed) - friction(qd[..., j])
        if "axle_side" in p:
            share = p["transmission"] if free else -p["share"]
            carried = p["rotor"] * qdd[..., j] + share * (load[..., j] + ROTORS[j] * qdd[..., j])
        else:
            carried = p["rotor"] * (qdd[..., j] + ratio * qdd[..., i]) + friction(speed)
        felt[..., i] = ratio * carried
        return felt


def _copied(states: dict[Any, Any]) -> dict[Any, Any]:
    return {key: _copied(value) if isinstance(value, dict) else value for key, value in states.items()}


def _harmonics(p: Any, angle: Array) -> Array:
    return sum(
        (
            p[f"cosine_{h}"] * np.cos(h * angle) + p[f"sine_{h}"] * np.sin(h * angle)
            for h in range(1, int(p["harmonics"]) + 1)
        ),
        np.zeros_like(angle),
    )


def _settled(follows: Any, before: Array, own: Array) -> Array:
    """The acceleration (n,) that follows from itself; gears see `own` (m, n) of it, and answer in proportion but where
    teeth meet within the step."""
    first = follows(before)
    answers = np.stack([follows(before + step) - first for step in np.linalg.pinv(own).T], axis=1)
    more = np.linalg.solve(np.eye(len(own)) - own @ answers, own @ (first - before))
    return np.asarray(first + answers @ more)


def _slopes(mujoco: Any, m: Any, d: Any, moved: Any, at: Array, dof: Array) -> Array:
    """(n, n) [N·m/rad] change of the inverse dynamics of the bodies with the position of each joint (columns)."""
    gradient, side = np.empty((len(dof), len(dof))), np.zeros((2, m.nv))
    moved.qvel[:], moved.qacc[:] = d.qvel, d.qacc
    for column, k in enumerate(at):
        for step, torque in zip((-1e-5, 1e-5), side, strict=True):
            moved.qpos[:] = d.qpos
            moved.qpos[k] += step
            mujoco.mj_kinematics(m, moved)
            mujoco.mj_comPos(m, moved)
            mujoco.mj_comVel(m, moved)
            mujoco.mj_rne(m, moved, 1, torque)
        gradient[:, column] = (side[1] - side[0])[dof] / 2e-5
    return gradient


def install(mujoco: Any, model: Any, joints: tuple[str, ...] = JOINTS) -> Effects:
    """Let MuJoCo apply the effects as passive forces (mjcb_passive) to the named joints of `model`.

    `mujoco` is that package. ARMATURE is added to the model's. Acceleration is that of the step before and what the
    effects change of it: a light rotor behind a heavy link follows its gear, not the link that MuJoCo ties to it.
    Friction changes sign more softly where a step of the model would overshoot. MuJoCo has one such callback for all
    models; None takes it off.
    """
    effects = Effects(dt=float(model.opt.timestep))
    at = np.array([int(model.joint(name).qposadr[0]) for name in joints])
    dof = np.array([int(model.joint(name).dofadr[0]) for name in joints])
    rotors = np.array(ROTORS)
    now: dict[str, Any] = {"time": -1.0}
    gears = [effect["joints"][0] for effect in EFFECTS if effect["form"] == "arm_two_mass"]
    moved = mujoco.MjData(model)

    def links(m: Any, d: Any) -> Array:
        columns = np.zeros((len(dof), m.nv))
        for column, k in zip(columns, dof, strict=True):
            mujoco.mj_mulM(m, d, column, np.eye(m.nv)[k])
        return columns[:, dof] - np.diag(rotors)

    def passive(m: Any, d: Any) -> None:
        if m.nv != model.nv or m.nq != model.nq:
            return
        if d.time != now["time"]:
            if d.time < now["time"] or now["time"] < 0:
                effects.reset()
            matrix = links(m, d)
            before, bias = d.qacc[dof].copy(), d.qfrc_bias[dof].copy()
            slope, whole = _slopes(mujoco, m, d, moved, at, dof) if gears else None, matrix + np.diag(rotors)

            def felt(qdd: Array) -> Array:
                return effects.torque(d.qpos[at], d.qvel[dof], qdd, matrix @ qdd + bias, matrix, slope)

            def follows(qdd: Array) -> Array:
                """The acceleration that follows if the effects see one."""
                states, time = _copied(effects._states), effects.time
                torque = felt(qdd)
                effects._states, effects.time = states, time
                return np.asarray(before + np.linalg.solve(whole, now["torque"] - torque))

            known = gears and now["time"] >= 0
            qdd = _settled(follows, before, matrix[gears]) if known else before
            now["torque"], now["time"] = felt(qdd), float(d.time)
        d.qfrc_passive[dof] -= now["torque"]

    model.dof_armature[dof] += effects.armature
    effects.armature = np.zeros(len(joints))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.diag(links(model, data)) + rotors
    levels = np.zeros(len(joints))
    for effect in EFFECTS:
        keys = ("rise", "level", "coulomb_change", "coulomb_asymmetry", "coulomb_drift", "coulomb", "reversal_level")
        levels[list(effect["joints"])] += sum(abs(effect["parameters"].get(key, 0.0)) for key in keys)
        grows = effect["parameters"].get("coefficient", 0.0)
        levels[list(effect["joints"])] += abs(grows) * np.abs(data.qfrc_bias[dof][list(effect["joints"])])
    effects.reversal = np.maximum(effects.reversal, effects.dt * levels / inertia)
    mujoco.set_mjcb_passive(passive)
    return effects
