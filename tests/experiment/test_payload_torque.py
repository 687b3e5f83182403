"""What a known mass asks of the drives: motions planned with it, or run with it, stay within their torque."""

from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core import Console, InputError
from agent.excitation import LoopProblem
from agent.experiment.pieces import Pieces
from agent.link import record, record_program_file, torque_limits
from agent.link.planning import check_load
from agent.model import payload_of
from agent.motion import FlyInterpolator, FlyTrajectory, FlyType, JointTarget, Move, MoveType, ViaRegions, with_frames
from agent.motion.pdl2 import write_program
from agent.motion.pdl2.settings import Pdl2Settings
from agent.motion.regions import BoxRegion
from agent.recipe import load_recipe, template
from agent.robot import Dynamics, TorqueLimits, kinematics_for
from agent.safety.planned_program import standstill_plan
from tests.small_arms import make_arm

ARM = make_arm("RRRRRR")
ARM = replace(ARM, joints=tuple(replace(joint, rotor_inertia=None) for joint in ARM.joints))
LOAD = payload_of("6 kg, 0 mm, 20 mm, 60 mm")


def limited(largest) -> object:
    """The arm with these largest torques [N·m]."""
    joints = [replace(joint, max_torque=float(limit)) for joint, limit in zip(ARM.joints, largest, strict=True)]
    return replace(ARM, joints=tuple(joints))


def torque(q, qd, qdd, load=None) -> np.ndarray:
    """Of the bodies, by another way than the check's: the arm with the mass as its tool."""
    return np.abs(Dynamics(ARM, load).inverse_dynamics(q, qd, qdd))


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_torque_limits_include_the_mass(seed):
    q, qd, qdd = np.random.default_rng(seed).uniform(-1, 1, (3, 30, 6))
    loaded = torque(q, qd, qdd, LOAD).max(axis=0)
    assert TorqueLimits(limited(loaded * 1.001), None, LOAD).overload(q, qd, qdd) is None
    joint = seed % 6
    excess, text = TorqueLimits(limited(np.where(np.arange(6) == joint, 0.5, 1.001) * loaded), None, LOAD).overload(
        q, qd, qdd
    )
    assert excess == pytest.approx(1.0, rel=1e-6)
    assert f"joint_{joint + 1} needs" in text


def test_every_piece_planned_with_a_mass_keeps_the_torque_limits():
    pose = kinematics_for(ARM, None).forward(np.array([[0.2, 0.2, 1.2, 0.3, 0.8, 0.2]]))[0]
    region = BoxRegion(pose, np.full(3, 0.1), 0.3)
    fly = Pdl2Settings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)
    problem = LoopProblem(robot=ARM, regions=ViaRegions((region,) * 4), settings=fly.changed(linear_speed=0.5))

    def drawn(one) -> list:
        pieces = Pieces(one, [1], 20.0, np.random.default_rng(3))
        return [piece for piece in (pieces.draw() for _ in range(12)) if piece is not None]

    motions = [piece.motion for piece in drawn(problem)]
    needed = [torque(m.q, m.qd, m.qdd, LOAD).max(axis=0) for m in motions]
    limits = np.median(needed, axis=0)
    tight = replace(problem, robot=limited(limits))
    kept = drawn(replace(tight, load=LOAD))
    assert len(kept) < len(drawn(tight))
    for piece in kept:
        m = piece.motion
        assert np.all(torque(m.q[::10], m.qd[::10], m.qdd[::10], LOAD) <= limits * (1 + 1e-9))


def test_refuses_an_overloading_program_before_motion(monkeypatch, tmp_path: Path):
    """A person may name any mass for any program."""
    start, program = np.full(6, 0.3), tmp_path / "p.pdl"
    move = Move(MoveType.JOINT, JointTarget(start + 0.05), with_frames(Pdl2Settings(), None))
    program.write_text(write_program("p", [move], ARM), encoding="utf-8")
    chain = FlyInterpolator(ARM, period=0.002).plan([move], start)
    bare = torque(chain.q, chain.qd, chain.qdd).max(axis=0)
    (tmp_path / "recipe.yaml").write_text(template(), encoding="utf-8")
    recipe = replace(load_recipe(tmp_path / "recipe.yaml"), robot=limited(bare * 1.05 + 0.1), tool=None)
    ran = []

    @contextmanager
    def link(recipe, console, *_, facts, limits, **__):
        guard = SimpleNamespace(position=lambda: start, takes_points=False, needs_slow_run=lambda program: False)
        opened = record.RobotLink(guard, recipe, console, {}, limits)
        monkeypatch.setattr(opened, "_record", lambda *_: ran.append(facts) or SimpleNamespace(lost=0))
        yield opened

    monkeypatch.setattr(record, "open_link", link)

    def run(load: str | None) -> None:
        record_program_file(recipe, program, tmp_path / "p.mcap", Console(-1), True, payload=load)

    run(None)
    run("1 g, 0, 0, 0")
    assert len(ran) == 2
    with pytest.raises(InputError, match=r"with the mass at the flange joint_\d needs .* mount a lighter one"):
        run("200 kg, 500 mm, 0, 0")
    assert len(ran) == 2


def test_warns_of_joints_without_max_torque(capsys):
    unknown = replace(ARM, joints=tuple(replace(joint, max_torque=None) for joint in ARM.joints))
    warnings: list[str] = []
    console = SimpleNamespace(warn=warnings.append)
    limits = torque_limits(SimpleNamespace(robot=unknown, tool=None), LOAD, console)
    assert "has no max_torque for joint_1" in warnings[0]
    check_load(limits, standstill_plan(np.zeros(6)))
