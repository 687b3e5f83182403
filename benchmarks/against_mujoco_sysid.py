"""The same arm, logs and parameters for MuJoCo's own system identification (`mujoco.sysid`) and for a diagnosis.

    python benchmarks/against_mujoco_sysid.py arm.xml [SEED …]     (needs pip install "mujoco[sysid]")

The arm is the file's with masses, friction and rotors that are wrong or missing, its torque MuJoCo's own inverse
dynamics. MuJoCo's fits every joint's frictionloss, damping and armature and every body's mass, each from the file's
value or a tenth of the joint's torque, to windows of 0.2 s that start at measured states and run by recorded torque:
positions and speeds, its own roll-outs, residuals and optimizer, on one core. Two motions are fitted to, the third is
run forward by either. First without an effect, then with one that none of these parameters is, on the third joint:
friction that grows with its load, a spring.
"""

from __future__ import annotations

import copy
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid

from agent.core.console import Console
from agent.diagnosis.forward.rollout import MujocoEngine, at_motors
from agent.model import ModelEffect
from agent.pipeline.gap.diagnose import GapQuestion, diagnose_files
from agent.recording import read_log
from agent.recording.mcap.log_file import STATES, LogFile

RATE, SECONDS = 125.0, 20.0
WINDOW, HORIZONS, STARTS = 0.2, np.array([0.2, 0.5, 1.0]), 40
JOINT = 2  # that has the effect


def load_dependent_friction(level, q, qd, load):
    return 0.12 * np.abs(load) * np.tanh(qd / 0.01)


def gravity_spring(level, q, qd, load):
    return 1.5 * level * np.cos(q - 0.4)


def motion(rng, low, high, count):
    """q, qd, qdd (S, n): sums of sines in the middle of the range, from a standstill."""
    t = np.arange(int(SECONDS * RATE)) / RATE
    low, high = (np.where(high > low, end, side) for end, side in ((low, -np.pi), (high, np.pi)))  # 0 0: unlimited
    middle, span = 0.5 * (low + high), np.minimum(high - low, 2 * np.pi)
    q, qd, qdd = np.zeros((3, len(t), count))
    for part, size in ((1, 0.22), (2, 0.1), (3, 0.05)):
        w, phase = part * rng.uniform(0.7, 1.3, count), rng.uniform(0, 2 * np.pi, count)
        a, amplitude = np.outer(t, w) + phase, size * span
        q, qd = q + amplitude * np.sin(a), qd + amplitude * w * np.cos(a)
        qdd = qdd - amplitude * w**2 * np.sin(a)
    return t, q + middle, qd, qdd


def robot(path, rng):
    """The file's arm with changed masses, inertias, friction and rotors, and its Coulomb levels."""
    model = mujoco.MjModel.from_xml_path(str(path))
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_ACTUATION | off.mjDSBL_AUTORESET
    for body in range(1, model.nbody):
        factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.05, 0.2)
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
        model.body_ipos[body] += rng.normal(0, 0.004, 3)
    size = inverse(model, *motion(rng, *model.jnt_range.T, model.nq)[1:]).std(axis=0)
    size = np.maximum(size, 0.1 * size.max())

    def own(given, missing):
        off = 1 + rng.choice([-1, 1], model.nv) * rng.uniform(0.05, 0.2, model.nv)
        return np.where(given > 0, given * off, missing * size * rng.uniform(0.7, 1.3, model.nv))

    coulomb = own(model.dof_frictionloss, 0.15)
    model.dof_armature[:] = own(model.dof_armature, 0.02)
    model.dof_damping[:] = own(model.dof_damping, 0.1)
    return model, coulomb


def inverse(model, q, qd, qdd):
    data = mujoco.MjData(model)
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse
    return torque


def recorded(path, seed, folder, put_in):
    """Three logs of a robot made of a file, with effects put in as functions on `JOINT`."""
    rng = np.random.default_rng(seed)
    model, coulomb = robot(path, rng)
    names, logs = tuple(model.joint(k).name for k in range(model.nv)), []
    for number in range(3):
        t, q, qd, qdd = motion(rng, *model.jnt_range.T, model.nq)
        torque = inverse(model, q, qd, qdd) + coulomb * np.tanh(qd / 0.01)
        load = torque - coulomb * np.tanh(qd / 0.01) - model.dof_damping * qd
        for effect in put_in:
            torque[:, JOINT] += effect(coulomb[JOINT], *(values[:, JOINT] for values in (q, qd, load)))
        torque += 0.005 * torque.std(axis=0) * rng.normal(size=torque.shape)
        logs.append(folder / f"{number}.mcap")
        file = LogFile(logs[-1], names, path.stem, f"motion {number}", RATE)
        file.write_states(STATES, 100 + t, q, qd, torque)
        file.finish()
        file.close()
    return logs


def drift(which, log, horizons, starts, causes=()):
    """(windows, horizons, n) position error of a simulator that is given a log's torque from its states on.

    `causes` of a result that are of the report say what torque the motors had.
    """
    errors = []
    entries = [ModelEffect(c["effect"], tuple(c["joints"]), c["parameters"]) for c in causes]
    effort = at_motors(entries, log.joint_names, log.effort)
    for first in starts:

        def drive(t, q, qd, at=first):
            return effort[min(at + round(t * RATE), len(log.t) - 1)]

        q, _ = which.run(log.position[first], log.velocity[first], drive, horizons)
        errors.append(q - log.position[first + np.round(horizons * RATE).astype(int)])
    return np.nan_to_num(np.array(errors), nan=np.pi).clip(-np.pi, np.pi)


def torque_driven(path, names):
    """The file with a motor, a position and a speed sensor on every joint, and without contacts."""
    spec = mujoco.MjSpec.from_file(str(path))
    for unused in (*spec.actuators, *spec.keys):
        spec.delete(unused)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for name in names:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gainprm[0] = 1.0
        for kind in ("POS", "VEL"):
            spec.add_sensor(
                name=f"{name}_{kind}",
                type=getattr(mujoco.mjtSensor, f"mjSENS_JOINT{kind}"),
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=name,
            )
    return spec


def with_parameters(given, x):
    """A compiled model with frictionloss, damping, armature of every joint and masses of bodies, from x."""
    model, n = copy.copy(given), given.nv
    model.dof_frictionloss[:], model.dof_damping[:], model.dof_armature[:] = x[:n], x[n : 2 * n], x[2 * n : 3 * n]
    heavy = np.flatnonzero(model.body_mass > 0)
    factor = x[3 * n :] / model.body_mass[heavy]
    model.body_mass[heavy] *= factor
    model.body_inertia[heavy] *= factor[:, None]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def windows(spec, logs, names):
    """Input of MuJoCo's identification: initial states, torque and measured motion of the windows."""
    model, found = spec.compile(), []
    size = int(WINDOW * RATE) + 1
    time_ = np.arange(size) / RATE
    for log in logs:
        for first in np.linspace(250, len(log.t) - 300, STARTS).astype(int):
            rows = slice(first, first + size)
            state = sysid.create_initial_state(model, log.position[first], log.velocity[first])
            motion = np.stack([log.position[rows], log.velocity[rows]], axis=2).reshape(size, -1)
            control = sysid.TimeSeries.from_control_names(time_, log.effort[rows], model)
            found.append((state, control, sysid.TimeSeries.from_names(time_, motion, model)))
    labels = [f"window {k}" for k in range(len(found))]
    return sysid.ModelSequences("arm", spec, labels, *map(list, zip(*found, strict=True)))


def by_sysid(path, names, logs):
    """A roll-out engine with what MuJoCo's identification finds, and its processor time."""
    started = time.process_time()
    spec = torque_driven(path, names)
    given = spec.compile()
    size = np.std(logs[0].effort, axis=0)
    mass = given.body_mass[given.body_mass > 0]
    nominal = np.concatenate([0.1 * size, 0.1 * size, 0.01 * size, mass])
    low, high = np.concatenate([0 * size, 0 * size, 1e-6 * size, 0.5 * mass]), 5 * nominal
    unknown = sysid.ParameterDict()
    unknown.add(sysid.Parameter("x", nominal, low, high))
    residual = sysid.build_residual_fn(
        models_sequences=[windows(spec, logs, names)],
        build_model=lambda parameters, _: with_parameters(given, parameters.as_vector()),
        n_threads=1,
    )
    found, _ = sysid.optimize(unknown, residual, verbose=False)
    seconds = time.process_time() - started
    engine = MujocoEngine(path, names)
    engine._model = with_parameters(engine._model, found.as_vector())
    return engine, seconds


def compare(path, seed, effects):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs = recorded(path, seed, folder, effects)
        fixed = folder / "fixed.xml"
        started = time.process_time()
        result = diagnose_files(None, logs[:2], GapQuestion(path, out=fixed), Console(-1))
        ours_s = time.process_time() - started
        read = [read_log(log) for log in logs]
        names = read[0].joint_names
        beside = folder / "fixed_effects.py"
        ours = MujocoEngine(fixed, names, beside if beside.exists() else None)
        theirs, theirs_s = by_sysid(path, names, read[:2])
        starts = np.linspace(250, len(read[2].t) - 300, 24).astype(int)
        named = [[c["effect"], *c["joints"], round(c["probability"], 2)] for c in result["causes"]]
        put_in = [[effect.__name__, names[JOINT]] for effect in effects]
        print(path.stem, seed, "put in:", put_in, "named:", named, result["verdict"])
        for called, which, seconds, causes in (
            ("given", MujocoEngine(path, names), 0.0, ()),
            ("sysid", theirs, theirs_s, ()),
            ("ours", ours, ours_s, result["causes"]),
        ):
            error = np.sqrt(np.mean(drift(which, read[2], HORIZONS, starts, causes) ** 2, axis=(0, 2)))
            print(f"  {called:6} {seconds:6.1f} s  error after {HORIZONS} s: {error.round(4)} rad", flush=True)


if __name__ == "__main__":
    for seed in map(int, sys.argv[2:] or ("5",)):
        for effects in ([], [load_dependent_friction], [gravity_spring]):
            compare(Path(sys.argv[1]), seed, effects)
