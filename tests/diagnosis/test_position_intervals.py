"""Intervals of servo numbers from positions and commands cover the numbers that the arm has."""

from pathlib import Path

import numpy as np
import pytest

from agent.diagnosis import diagnose
from agent.model import CATALOGUE
from agent.recording import HOLD, Log
from agent.simulators import load_simulator

mujoco = pytest.importorskip("mujoco")
SECONDS, STEP, ENCODER = 12.0, 0.002, 2 * np.pi / 4096
FILE = """<mujoco model="drawn"><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="upper">
    <joint name="lift" axis="0 1 0" armature="{armature[0]}" damping="{damping[0]}" frictionloss="{friction[0]}"/>
    <inertial pos="0.12 0 0" mass="0.25" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="fore" pos="0.2 0 0">
      <joint name="elbow" axis="0 1 0" armature="{armature[1]}" damping="{damping[1]}" frictionloss="{friction[1]}"/>
      <inertial pos="0.1 0 0" mass="0.15" diaginertia="5e-4 5e-4 5e-4"/></body></body></worldbody>
  <actuator><position joint="lift" kp="{kp[0]}" forcerange="-3 3"/>
    <position joint="elbow" kp="{kp[1]}" forcerange="-3 3"/></actuator></mujoco>
"""
USUAL = {"kp": 18.0, "damping": 0.8, "armature": 0.03, "friction": 0.07}


def drawn(seed: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], float, float]:
    """Numbers of an arm and of its file, its delay [s], and the recorder's rate [Hz]."""
    rng = np.random.default_rng(seed)
    arm = {name: size * np.exp(0.2 * rng.normal(size=2)) for name, size in USUAL.items()}
    file = {name: values * np.exp(0.3 * rng.normal(size=2)) for name, values in arm.items()}
    return (
        arm,
        {**file, "kp": arm["kp"] * np.exp(0.1 * rng.normal(size=2))},
        STEP * rng.integers(0, 40),
        rng.choice([25, 50, 100]),
    )


def recorded(numbers: dict[str, np.ndarray], late: float, rate: float, seed: int) -> Log:
    """Steps with rests and waves, held from frame to frame."""
    model, rng = mujoco.MjModel.from_xml_string(FILE.format(**numbers)), np.random.default_rng(seed)
    data, t = mujoco.MjData(model), np.arange(int(SECONDS * rate)) / rate
    steps = 0.25 * rng.normal(size=(int(SECONDS), 2))[(t // 1.0).astype(int)]
    waves = sum(
        a * np.sin(np.outer(t, w * rng.uniform(0.8, 1.2, 2)) + rng.uniform(0, 6, 2))
        for a, w in ((0.5, 1.1), (0.1, 6.0))
    )
    r, q = np.where((t % 4 < 2)[:, None], steps, waves), np.empty((len(t), 2))
    ahead = round(1.0 / STEP)
    command = np.clip(
        ((np.arange(-ahead, int(SECONDS / STEP) + 1) * STEP - late) * rate + 1e-6).astype(int), 0, len(r) - 1
    )
    at = np.round(t / STEP).astype(int)
    path = np.empty((int(SECONDS / STEP) + 1, 2))
    for k, row in enumerate(command):
        if k >= ahead:
            path[k - ahead] = data.qpos
        data.ctrl[:] = r[row]
        mujoco.mj_step(model, data)
    q = np.round(path[at] / ENCODER) * ENCODER
    metadata = {"robot": "x", HOLD: "held"}
    return Log(
        Path(f"{seed}.mcap"),
        ("lift", "elbow"),
        t,
        q,
        None,
        None,
        r,
        None,
        rate,
        100.0,
        ((0, len(t)),),
        metadata=metadata,
    )


@pytest.mark.verify
def test_intervals_of_200_draws_cover_the_numbers(tmp_path):
    inside: dict[str, list[bool]] = {}
    for seed in range(200):
        arm, file, late, rate = drawn(seed)
        path = tmp_path / f"{seed}.xml"
        path.write_text(FILE.format(**file), encoding="utf-8")
        simulator = load_simulator(path, None, ("lift", "elbow"), None)
        logs = [recorded(arm, late, float(rate), 1000 * seed + k) for k in range(3)]
        servo = diagnose(simulator.robot, logs, simulator.model, without=tuple(CATALOGUE), simulator=simulator).result[
            "servo"
        ]
        true = {**arm, "delay_s": np.full(2, late)}
        for name, values in true.items():
            for value, told in zip(values, servo[name], strict=True):
                if told is not None:
                    inside.setdefault(name, []).append(told[1] <= value <= told[2])
    covered = {name: float(np.mean(one)) for name, one in inside.items()}
    assert all(len(one) > 200 for one in inside.values())
    assert min(covered.values()) > 0.92, covered
