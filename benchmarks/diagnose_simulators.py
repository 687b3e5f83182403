"""Robots made of other people's MJCFs: wrong inertias and frictions, one or two effects, then diagnosed and corrected.

    python benchmarks/diagnose_simulators.py OUT.json DRAWS arm.xml …

The robot's torque is MuJoCo's own inverse dynamics of the file with masses 5 to 20 % off and friction and rotors that
the file does not have, plus effects written here and not with the agent's forms. Printed per draw: what was put in,
what was named, position error after 1 s forward, of the given simulator and of the corrected one.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np

from agent.core.console import Console
from agent.pipeline.diagnose import GapQuestion, diagnose_files
from agent.recording.mcap.log_file import STATES, LogFile

RATE, SECONDS, LOGS = 250.0, 20.0, 3


def stribeck(level, q, qd, torque):
    return 0.6 * level * np.tanh(qd / 0.01) / (1 + (qd / 0.15) ** 2)


def asymmetric_friction(level, q, qd, torque):
    return 0.5 * level * (np.abs(np.tanh(qd / 0.01)) + 0.5 * np.abs(qd))


def load_dependent_friction(level, q, qd, torque):
    return 0.12 * np.abs(torque) * np.tanh(qd / 0.01)


def viscous_nonlinearity(level, q, qd, torque):
    return -0.6 * level * qd * np.abs(qd)


def gravity_spring(level, q, qd, torque):
    return 1.5 * level * np.cos(q - 0.4)


def torque_constant(level, q, qd, torque):
    return 0.1 * torque


EFFECTS = (
    stribeck,
    asymmetric_friction,
    load_dependent_friction,
    viscous_nonlinearity,
    gravity_spring,
    torque_constant,
)


def motion(rng, low, high, count):
    """q, qd, qdd (S, n): sums of sines in the middle of the range, at rest where it starts."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    span = np.minimum(high - low, 2 * np.pi)
    q, qd, qdd = np.zeros((3, len(t), count))
    for part, size in ((1, 0.22), (2, 0.1), (3, 0.05)):
        w, phase = part * rng.uniform(0.7, 1.3, count), rng.uniform(0, 2 * np.pi, count)
        a, amplitude = np.outer(t, w) + phase, size * span
        q, qd = q + amplitude * np.sin(a), qd + amplitude * w * np.cos(a)
        qdd = qdd - amplitude * w**2 * np.sin(a)
    return t, q + 0.5 * (np.clip(low, -np.pi, np.pi) + np.clip(high, -np.pi, np.pi)), qd, qdd


def robot(path, rng):
    """The file's arm with masses, inertias, friction and rotors of its own, and its parameters' sizes."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    for body in range(1, model.nbody):
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2)
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
        model.body_ipos[body] += rng.normal(0, 0.004, 3)
    size = inverse(model, *motion(rng, *model.jnt_range.T, model.nq)[1:]).std(axis=0)
    size = np.maximum(size, 0.1 * size.max())
    model.dof_armature[:] = 0.02 * size
    return model, 0.15 * size * rng.uniform(0.7, 1.3, model.nv), 0.1 * size * rng.uniform(0.7, 1.3, model.nv), size


def inverse(model, q, qd, qdd):
    data = mujoco.MjData(model)
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse
    return torque


def recorded(path, seed, folder, effects=None):
    """Logs of a robot made of a file, and what was put in; `effects`: these and not drawn ones, as (form, joint)."""
    rng = np.random.default_rng(seed)
    model, coulomb, viscous, _ = robot(path, rng)
    chosen = [EFFECTS[k] for k in rng.choice(len(EFFECTS), rng.integers(1, 3), replace=False)]
    joints = rng.choice(model.nv - 1, len(chosen), replace=False)
    put_in = list(zip(chosen, joints, strict=True)) if effects is None else effects
    names, logs = tuple(model.joint(k).name for k in range(model.nv)), []
    for number in range(LOGS):
        t, q, qd, qdd = motion(rng, *model.jnt_range.T, model.nq)
        torque = inverse(model, q, qd, qdd) + coulomb * np.tanh(qd / 0.01) + viscous * qd
        for effect, k in put_in:
            torque[:, k] += effect(coulomb[k], q[:, k], qd[:, k], torque[:, k])
        torque += 0.005 * torque.std(axis=0) * rng.normal(size=torque.shape)
        file = LogFile(folder / f"{number}.mcap", names, path.stem, f"motion {number}", RATE)
        file.write_states(STATES, 100 + t, q, qd, torque)
        file.finish()
        file.close()
        logs.append(folder / f"{number}.mcap")
    return logs, [[effect.__name__, names[k]] for effect, k in put_in]


def draw(path, seed):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs, put_in = recorded(path, seed, folder)
        started = time.process_time()
        result = diagnose_files(None, logs, GapQuestion(path, out=folder / f"fixed{path.suffix}"), Console(-1))
        seconds = time.process_time() - started
    forward = result.get("forward", {})
    at = forward.get("horizon_s", []).index(1.0) if forward else 0
    return {
        "arm": path.stem,
        "seed": seed,
        "put_in": put_in,
        "verdict": result["verdict"],
        "named": [[c["effect"], *c["joints"], round(c["probability"], 2)] for c in result["causes"]],
        "equal": [[e["effect"], *e["joints"]] for c in result["causes"][:1] for e in c["equivalent_to"]],
        "closure": result["closure"],
        "forward_1s": {side: np.round(forward[side][at], 4).tolist() for side in ("before", "after") if forward},
        "cpu_s": round(seconds, 1),
    }


if __name__ == "__main__":
    out, draws, *paths = sys.argv[1:]
    found = []
    for seed in range(int(draws)):
        for path in paths:
            found.append(draw(Path(path), seed))
            print(json.dumps(found[-1]), flush=True)
            Path(out).write_text(json.dumps(found, indent=1))
