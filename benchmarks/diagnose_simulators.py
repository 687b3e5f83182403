"""Robots made of other people's MJCFs: wrong inertias and frictions, one to three effects, diagnosed and corrected.

    python benchmarks/diagnose_simulators.py OUT.jsonl FIRST LAST arm.xml …    (seeds; what OUT has is not done again)

The robot's torque is MuJoCo's own inverse dynamics of the file with masses, and friction and rotors that the file has,
5 to 20 % off, friction and rotors that it does not have, and effects written here and not with the agent's forms. Per
draw: what was put in, what was named, and position errors forward on two motions that the diagnosis never saw: of the
given file, of the corrected file with its effects in MuJoCo, and of the true arm (the oracle: what noise alone leaves).
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
from agent.diagnosis.rollout import MujocoEngine, at_motors
from agent.model import ModelEffect
from agent.pipeline.diagnose import GapQuestion, diagnose_files
from agent.recording import read_log
from agent.recording.mcap.log_file import STATES, LogFile

RATE, SECONDS, LOGS, UNSEEN = 125.0, 20.0, 3, 2
HORIZONS, STARTS = np.array([0.2, 0.5, 1.0]), 6


def stribeck(level, q, qd, torque, load):
    return 0.6 * level * np.tanh(qd / 0.01) / (1 + (qd / 0.15) ** 2)


def asymmetric_friction(level, q, qd, torque, load):
    return 0.5 * level * (np.abs(np.tanh(qd / 0.01)) + 0.5 * np.abs(qd))


def load_dependent_friction(level, q, qd, torque, load):
    return 0.12 * np.abs(load) * np.tanh(qd / 0.01)


def viscous_nonlinearity(level, q, qd, torque, load):
    return -0.6 * level * qd * np.abs(qd)


def gravity_spring(level, q, qd, torque, load):
    return 1.5 * level * np.cos(q - 0.4)


def torque_constant(level, q, qd, torque, load):
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
    """The file's arm with masses, inertias, friction and rotors of its own, and its Coulomb levels."""
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


class Oracle:
    """The true arm forward: recorded torque, less friction and effects, in steps of 1 ms."""

    def __init__(self, model, coulomb, put_in):
        self._model, self._coulomb, self._put_in = model, coulomb, put_in
        model.opt.timestep = 1e-3

    def run(self, q, qd, drive, times):
        data = mujoco.MjData(self._model)
        data.qpos[:], data.qvel[:] = q, qd
        found = np.empty((2, len(times), len(q)))
        for row, until in enumerate(times):
            while data.time < until - 0.25 * self._model.opt.timestep:
                q, qd = data.qpos, data.qvel
                given = drive(data.time, q, qd)
                torque, dry = given.copy(), self._coulomb * np.tanh(qd / 0.01)
                rubbing = dry + self._model.dof_damping * qd
                for effect, k in self._put_in:
                    for _ in range(3):  # the effect is of the torque without it
                        load = torque[k] - rubbing[k]
                        torque[k] = given[k] - effect(self._coulomb[k], q[k], qd[k], torque[k], load)
                data.qfrc_applied[:] = torque - dry
                mujoco.mj_step(self._model, data)
                if not np.abs(data.qvel).max() < 1e3:  # explicit friction of a light joint may blow up
                    found[:, row:] = np.nan
                    return found[0], found[1]
            found[:, row] = data.qpos, data.qvel
        return found[0], found[1]


def recorded(path, seed, folder, effects=None, count=LOGS):
    """Logs of a robot made of a file, what was put in, the oracle; `effects`: these, as (form, joint), none drawn."""
    rng = np.random.default_rng(seed)
    model, coulomb = robot(path, rng)
    chosen = [EFFECTS[k] for k in rng.choice(len(EFFECTS), rng.integers(1, 4), replace=False)]
    joints = rng.choice(model.nv - 1, len(chosen), replace=False)
    put_in = list(zip(chosen, joints, strict=True)) if effects is None else effects
    names, logs = tuple(model.joint(k).name for k in range(model.nv)), []
    for number in range(count):
        t, q, qd, qdd = motion(rng, *model.jnt_range.T, model.nq)
        torque = inverse(model, q, qd, qdd) + coulomb * np.tanh(qd / 0.01)
        load = torque - coulomb * np.tanh(qd / 0.01) - model.dof_damping * qd
        for effect, k in put_in:
            torque[:, k] += effect(coulomb[k], q[:, k], qd[:, k], torque[:, k], load[:, k])
        torque += 0.005 * torque.std(axis=0) * rng.normal(size=torque.shape)
        logs.append(folder / f"{number}.mcap")
        file = LogFile(logs[-1], names, path.stem, f"motion {number}", RATE)
        file.write_states(STATES, 100 + t, q, qd, torque)
        file.finish()
        file.close()
    return logs, [[effect.__name__, names[k]] for effect, k in put_in], Oracle(model, coulomb, put_in)


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


def draw(path, seed):
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs, put_in, oracle = recorded(path, seed, folder, count=LOGS + UNSEEN)
        fixed, effects = folder / f"fixed{path.suffix}", folder / "fixed_effects.py"
        started = time.process_time()
        question = GapQuestion(path, out=fixed, report=folder / "page.html")
        result = diagnose_files(None, logs[:LOGS], question, Console(-1))
        seconds = time.process_time() - started
        unseen = [read_log(log) for log in logs[LOGS:]]
        names = unseen[0].joint_names
        starts = np.linspace(100, len(unseen[0].t) - 2 * RATE - 100, STARTS).astype(int)
        arms = {
            "given": MujocoEngine(path, names),
            "fixed": MujocoEngine(fixed, names, effects if effects.exists() else None),
            "oracle": oracle,
        }
        errors = {}
        for side, arm in arms.items():
            causes = result["causes"] if side == "fixed" else ()
            all_errors = np.concatenate([drift(arm, log, HORIZONS, starts, causes) for log in unseen])
            errors[side] = np.sqrt(np.mean(all_errors**2, axis=0))
        changes = json.loads((folder / "fixed.changes.json").read_text(encoding="utf-8"))
    promised = np.array(result["forward"]["after_interval"])[: len(HORIZONS)]
    inside = (promised[..., 0] <= errors["fixed"]) & (errors["fixed"] <= promised[..., 1])
    whole = {side: np.sqrt(np.mean(error**2, axis=1)) for side, error in errors.items()}
    return {
        "arm": path.stem,
        "seed": seed,
        "put_in": put_in,
        "verdict": result["verdict"],
        "named": [[c["effect"], *c["joints"], round(c["probability"], 2)] for c in result["causes"]],
        "equal": [[e["effect"], *e["joints"]] for c in result["causes"][:1] for e in c["equivalent_to"]],
        "closure": result["closure"],
        "forward": {side: error.round(5).tolist() for side, error in whole.items()},
        "forward_closed": ((whole["given"] - whole["fixed"]) / (whole["given"] - whole["oracle"])).round(4).tolist(),
        "inside": inside.mean(axis=1).round(3).tolist(),
        "below": (errors["fixed"] < promised[..., 0]).mean(axis=1).round(3).tolist(),
        "promised": [result["forward"]["after"][: len(HORIZONS)], promised.tolist(), errors["fixed"].tolist()],
        "changes": len(changes["changes"]),
        "cpu_s": round(seconds, 1),
    }


if __name__ == "__main__":
    out, first, last, *paths = sys.argv[1:]
    results = Path(out)
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    done = {(entry["arm"], entry["seed"]) for entry in map(json.loads, lines)}
    for seed in range(int(first), int(last) + 1):
        for path in map(Path, paths):
            if (path.stem, seed) not in done:
                found = draw(path, seed)
                with results.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(found) + "\n")
                print(json.dumps({key: value for key, value in found.items() if key != "promised"}), flush=True)
