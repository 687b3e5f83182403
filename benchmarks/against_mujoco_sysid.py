"""The same arm, logs and parameters for MuJoCo's own system identification and for a diagnosis.

    python benchmarks/against_mujoco_sysid.py arm.xml

MuJoCo's fits every joint's frictionloss, damping and armature and every body's mass to windows of 0.2 s that start at
measured states and run by recorded torque. Two motions are fitted to, the third is run forward by either. First without
an effect that neither can move, then with friction that grows with the load on the third joint.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from diagnose_simulators import load_dependent_friction, recorded
from mujoco.sysid._src import optimize, parameter

from agent.core.console import Console
from agent.diagnosis.rollout import MujocoEngine
from agent.pipeline.diagnose import GapQuestion, diagnose_files
from agent.recording import read_log

WINDOW, HORIZONS, STARTS, ITERATIONS = 0.2, np.array([0.2, 0.5, 1.0]), 12, 12


def with_parameters(path, x):
    """The file's model with frictionloss, damping, armature of every joint and masses of bodies, from x."""
    model = mujoco.MjModel.from_xml_path(str(path))
    n = model.nv
    model.dof_frictionloss[:], model.dof_damping[:], model.dof_armature[:] = x[:n], x[n : 2 * n], x[2 * n : 3 * n]
    heavy = np.flatnonzero(model.body_mass > 0)
    factor = x[3 * n :] / model.body_mass[heavy]
    model.body_mass[heavy] *= factor
    model.body_inertia[heavy] *= factor[:, None]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def drift(which, log, horizons, starts):
    """(windows, horizons, n) position error."""
    errors = []
    for first in starts:

        def drive(t, q, qd, at=first):
            return log.effort[min(at + round(t * 250), len(log.t) - 1)]

        q, _ = which.run(log.position[first], log.velocity[first], drive, horizons)
        errors.append(q - log.position[first + np.round(horizons * 250).astype(int)])
    return np.nan_to_num(np.array(errors), nan=np.pi).clip(-np.pi, np.pi)


def by_sysid(path, names, logs):
    """A roll-out engine with what MuJoCo's identification finds, and its processor time."""
    model = mujoco.MjModel.from_xml_path(str(path))
    size = np.std(logs[0].effort, axis=0)
    mass = model.body_mass[model.body_mass > 0]
    nominal = np.concatenate([0.1 * size, 0.1 * size, 0.01 * size, mass])
    low, high = np.concatenate([0 * size, 0 * size, 1e-6 * size, 0.5 * mass]), 5 * nominal
    unknown = parameter.ParameterDict()
    unknown.add(parameter.Parameter("x", nominal, low, high))
    which = MujocoEngine(path, names)
    starts = np.linspace(250, len(logs[0].t) - 300, STARTS).astype(int)

    def residual(x, *_, **__):
        which._model = with_parameters(path, np.asarray(x).ravel())
        which._model.opt.disableflags |= 1 << 4
        return np.concatenate([drift(which, log, np.array([WINDOW]), starts).ravel() for log in logs])

    started = time.process_time()
    found, _ = optimize.optimize(
        unknown, residual, optimizer="scipy", verbose=False, max_iters=ITERATIONS, x_scale="jac", diff_step=1e-3
    )
    seconds = time.process_time() - started
    residual(found.as_vector())
    return which, seconds


def compare(path, effects):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs, put_in = recorded(path, 5, folder, effects)
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
        print("put in:", put_in, "named:", [[c["effect"], *c["joints"]] for c in result["causes"]], result["verdict"])
        for called, which, seconds in (
            ("given", MujocoEngine(path, names), 0.0),
            ("sysid", theirs, theirs_s),
            ("ours", ours, ours_s),
        ):
            error = np.sqrt(np.mean(drift(which, read[2], HORIZONS, starts) ** 2, axis=(0, 2)))
            print(f"  {called:6} {seconds:6.1f} s  error after {HORIZONS} s: {error.round(4)} rad", flush=True)


if __name__ == "__main__":
    compare(Path(sys.argv[1]), [])
    compare(Path(sys.argv[1]), [(load_dependent_friction, 2)])
