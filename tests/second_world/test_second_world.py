"""Arms in MuJoCo: their physics against another library's, what recorders leave of logs, and how runs are drawn."""

from __future__ import annotations

import builtins
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from agent.blind_check import BlindCheck
from agent.blind_check.worlds import SecondWorld
from agent.core.console import Console
from agent.model import CATALOGUE
from agent.recording import read_log
from agent.robot import load_robot
from benchmarks.active.machines import MujocoMachines
from fake_controller.withheld.cases import Case

pytest.importorskip("mujoco", reason="mujoco is not installed: pip install calibration-agent[mujoco]")

from second_world.__main__ import main, run
from second_world.arms import BUILDS, draw_arm, write_description
from second_world.draw import draw_cases, recorder
from second_world.faults import OUTSIDE, build_in
from second_world.motions import RATE, draw_motions
from second_world.plant import largest_change, simulate


@pytest.mark.parametrize("machine", range(len(BUILDS)))
def test_without_friction_the_torque_is_the_inverse_dynamics_of_another_library(machine: int, tmp_path: Path) -> None:
    from agent.robot.dynamics import Dynamics

    arm = draw_arm(machine)
    arm.coulomb[:] = arm.viscous[:] = 1e-9
    arm.by_engine = True
    arm.described_mass, arm.described_centre = arm.mass, arm.centre
    robot = load_robot(str(write_description(arm, tmp_path, None)))
    motions = {"multisine": draw_motions(1, arm.range, arm.speed, 1.0)["multisine"]}
    out, (torque,) = simulate(arm, build_in(arm, ()), machine, motions)
    q, qd = out["multisine"]["position"], out["multisine"]["velocity"]
    qdd = np.diff(qd, axis=0) * RATE  # over the step that the torque acts in
    expected = Dynamics(robot).inverse_dynamics(q[:-1], qd[:-1], qdd) + arm.rotor * qdd
    assert np.abs((torque[:-1] - expected) / arm.torque).max() < 1e-3


def test_every_effect_comes_up_and_has_a_law() -> None:
    drawn = Counter()
    for case in draw_cases(80, 4):
        build_in(draw_arm(case["machine"]), case["effects"])
        drawn.update(effect["effect"] for effect in case["effects"])
    assert set(drawn) == (set(CATALOGUE) - {"interpolator_mismatch"}) | set(OUTSIDE)
    assert not set(OUTSIDE) & set(CATALOGUE)


def test_an_effect_without_a_law_is_refused() -> None:
    with pytest.raises(ValueError, match="no law for the effect 'rust'"):
        build_in(draw_arm(0), [{"effect": "rust", "joints": [], "parameters": {}}])


def test_half_of_the_machines_of_every_build_are_recorded_as_real_ones_are() -> None:
    kept = Counter((machine % len(BUILDS), recorder(machine)) for machine in range(40))
    assert set(kept.values()) == {5}


@pytest.mark.parametrize(
    ("effect", "joint", "parameters"),
    [
        ("joint_elasticity", "joint_2", {"stiffness": 400.0, "damping": 2.0}),
        ("backlash", "joint_2", {"gap": 0.02, "damping": 0.5}),
        ("wrist_coupling", "joint_5,joint_6", {"ratio": 1.0, "moved": 1.0, "coulomb": 0.1, "viscous": 0.1}),
    ],
)
def test_what_gives_way_in_a_gear_or_couples_the_wrist_shows_in_the_torque(effect, joint, parameters) -> None:
    told = []
    for effects in ([{"effect": effect, "joints": joint.split(","), "parameters": parameters}], []):
        arm = draw_arm(0)
        motions = draw_motions(1, arm.range, arm.speed, 1.0)
        told.append(simulate(arm, build_in(arm, effects), 0, motions)[1])
    assert all(np.isfinite(torque).all() for torque in told[0])
    assert 0.002 < largest_change(*told, arm.torque) < 1.0


@pytest.mark.parametrize("by_engine", [True, False])
@pytest.mark.parametrize(
    ("effect", "none", "some"),
    [
        ("stribeck", {"rise": 0.0, "speed": 0.1}, {"rise": 8.0, "speed": 0.1}),
        ("asymmetric_friction", {"coulomb": 0, "viscous": 0}, {"coulomb": 0.5, "viscous": 0.5}),
        ("viscous_nonlinearity", {"added": 0.0, "speed": 9e9, "power": 0}, {"added": 9.0, "speed": 0.2, "power": 0.2}),
        ("load_dependent_friction", {"coefficient": 0.0}, {"coefficient": 0.2}),
        ("presliding", {"share": 0.0, "travel": 0.02}, {"share": 0.8, "travel": 0.05}),
        ("thermal_friction", {"coulomb": 0, "viscous": 0, "way": 1}, {"coulomb": 1.0, "viscous": 0.5, "way": 3.0}),
    ],
)
def test_an_effect_of_friction_changes_nothing_but_its_own(effect, none, some, by_engine) -> None:
    """Whoever makes the friction: one of no size leaves every reversal as it was."""
    told = []
    for parameters in ({}, none, some):
        arm = draw_arm(0)
        arm.by_engine = by_engine
        effects = [{"effect": effect, "joints": ["joint_2"], "parameters": parameters}] if parameters else []
        told.append(simulate(arm, build_in(arm, effects), 0, draw_motions(1, arm.range, arm.speed, 1.0))[1])
    without, nothing, something = told
    assert largest_change(nothing, without, arm.torque) < 1e-9
    assert 0.003 < largest_change(something, without, arm.torque) < 0.3


def test_a_recorder_rounds_stamps_late_and_loses_rows_and_the_description_is_a_placeholder(tmp_path: Path) -> None:
    machine = next(m for m in range(8) if recorder(m) == "as recorded")
    job = {"machine": machine, "motion": 3, "effects": [], "folder": str(tmp_path), "cycle": 1.0}
    answer = run({**job, "describe": str(tmp_path)})
    assert answer["size"] is None
    robot = load_robot(str(tmp_path / "robot.yaml"))
    log = read_log(Path(answer["logs"][0]), robot)
    assert np.allclose(log.position * 1e4, np.round(log.position * 1e4), atol=1e-6)
    whole = round(RATE / 2 * 2.3)
    assert 0.94 * whole < len(log.t) < 0.99 * whole
    masses = re.findall('mass value="(.*?)"', (tmp_path / "arm.urdf").read_text())
    assert len(masses) == robot.dof
    assert len(set(masses)) == 1


def test_the_blind_check_draws_from_it_and_the_logs_do_not_tell(tmp_path: Path) -> None:
    world = SecondWorld(0.5)
    drawn = world.draw(12, 2)
    truth = next(truth for truth in drawn if truth["kind"] == "one")
    assert min(truth["machine"] for truth in drawn) > 2**32
    assert world.write(truth, tmp_path) > 0
    assert sorted(path.name for path in (tmp_path / "baseline").iterdir()) == [
        "multisine.mcap",
        "stops.mcap",
        "sweeps.mcap",
    ]
    logs = sorted((tmp_path / "logs").iterdir())
    assert [log.name for log in logs] == ["multisine.mcap", "stops.mcap", "sweeps.mcap"]
    robot = load_robot(str(tmp_path / "robot.yaml"))
    assert read_log(logs[0], robot).joint_names == tuple(robot.joint_names)
    assert not any(truth["effects"][0]["effect"].encode() in log.read_bytes() for log in logs)


def test_without_mujoco_it_says_what_to_install(monkeypatch, capsys) -> None:
    known = builtins.__import__

    def missing(name, *rest):
        if name == "mujoco":
            raise ImportError(name)
        return known(name, *rest)

    monkeypatch.setattr(builtins, "__import__", missing)
    assert main(["draw", "1", "1"]) == 2
    assert "pip install 'calibration-agent[mujoco]'" in capsys.readouterr().err


@pytest.mark.verify
def test_eight_runs_are_diagnosed_and_scored_by_recorder(tmp_path: Path) -> None:
    scores = BlindCheck(SecondWorld(), 8, tmp_path).run(Console(verbosity=-1))["tools"]["agent diagnose"]
    assert scores["runs"] == 8
    assert set(scores["recorders"]) <= {"clean", "as recorded"}


def test_set_points_that_are_given_are_followed_one_after_the_other(tmp_path):
    arm = draw_arm(2)
    ramp = 0.2 * (1 - np.cos(np.pi * np.arange(800) / 799))[:, None] * np.ones(arm.n)
    for name, points in (("there", ramp), ("back", ramp[::-1])):
        np.save(tmp_path / f"{name}.npy", points)
    files = {name: str(tmp_path / f"{name}.npy") for name in ("there", "back")}
    job = {"machine": 2, "motion": 5, "effects": [], "folder": str(tmp_path / "run"), "set_points": files}
    answer = run({**job, "cycles": {"back": [0.2, 0.5]}})
    assert [Path(log).stem for log in answer["logs"]] == ["there", "back"]
    for log, end in zip(answer["logs"], (0.4, 0.0), strict=True):
        reached = read_log(Path(log)).position[-1]
        assert reached == pytest.approx(np.full(arm.n, end), abs=0.05)
    assert [len(read_log(Path(log)).cycle_starts) for log in answer["logs"]] == [0, 2]


@pytest.mark.verify
@pytest.mark.parametrize("machine", range(4))
def test_every_build_has_a_sub_region_of_its_own(tmp_path, machine):
    case = Case(machine, "none", machine, 7, 1.0, ())
    recipe = MujocoMachines().recipe(case, tmp_path / "machine")
    assert recipe.robot.name == draw_arm(machine).build.name
    assert recipe.motion.via_points.box is not None
