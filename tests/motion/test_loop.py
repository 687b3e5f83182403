"""The loop's moves, and interpolators by name."""

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import FlyInterpolator, MoveType, ViaRegions, create_interpolator, interpolator_names, loop_moves
from agent.motion.path_settings import FlyTrajectory, FlyType
from agent.motion.pdl2.settings import Pdl2Settings, Termination

SETTINGS = Pdl2Settings(
    fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02, linear_speed=0.6
)


@pytest.fixture
def poses():
    box = ViaRegions.from_box(6, [1.0, 0.0, 0.8], [0.4, 0.6, 0.3], [0.0, np.pi, 0.0], 0.3)
    return box.poses(np.random.default_rng(4).random(36))


def test_a_cycle_blends_and_ends_fine_at_its_start(fly, kinematics, home, poses):
    moves = loop_moves(poses, SETTINGS)
    assert [move.fly for move in moves] == [True] * 5 + [False]
    assert all(move.type is MoveType.LINEAR for move in moves)
    assert moves[-1].settings.termination is Termination.FINE
    start = kinematics.solve(poses[0], home)
    first = fly.plan(moves, start)
    assert np.max(np.abs(first.q[-1] - start)) < 1e-9
    second = fly.plan(moves, first.q[-1])
    assert first.q.shape == second.q.shape
    assert np.max(np.abs(first.q - second.q)) < 1e-9


def test_two_cycles_in_one_program_repeat_sample_by_sample(fly, kinematics, home, poses):
    moves = loop_moves(poses, SETTINGS)
    start = kinematics.solve(poses[0], home)
    once, twice = fly.plan(moves, start), fly.plan([*moves, *moves], start)
    assert len(twice.q) == 2 * len(once.q) - 1
    assert np.max(np.abs(twice.q[len(once.q) - 1 :] - once.q)) < 1e-9


def test_interpolators_have_names(ns16):
    assert {"fly", "orl"} <= set(interpolator_names())
    assert isinstance(create_interpolator("fly", ns16, None, period=0.004), FlyInterpolator)
    with pytest.raises(InputError, match="there are: fly"):
        create_interpolator("nobody", ns16)


def test_an_installed_package_adds_its_interpolator(ns16, tmp_path, monkeypatch):
    (tmp_path / "straight.py").write_text(
        "class Straight:\n    def __init__(self, robot, tool=None, period=0.002):\n        self.period = period\n"
    )
    metadata = tmp_path / "straight-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: straight\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[calibration_agent.interpolators]\nstraight = straight:Straight\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "straight" in interpolator_names()
    assert create_interpolator("straight", ns16, None, period=0.004).period == 0.004
