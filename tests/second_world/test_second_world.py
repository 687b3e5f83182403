"""The family of simulated worlds: its physics against another library's, what is drawn, and what recorders leave."""

import builtins
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.blind_check import BlindCheck
from agent.blind_check.worlds import SecondWorld
from agent.core.console import Console
from agent.recording import read_log
from agent.robot import load_robot

pytest.importorskip("mujoco", reason="mujoco is not installed: pip install calibration-agent[mujoco]")

from fake_controller.actuation import EFFECTS
from second_world.__main__ import main, run
from second_world.arms import CLASSES, write_description
from second_world.draw import draw_cases
from second_world.laws import LAWS, OUTSIDE
from second_world.machine import DrawnMachine, largest_change
from second_world.motions import RATE, draw_motions
from second_world.sizing import build, sized
from second_world.world import FRICTION, DrawnWorld, draw_world, machine_number

EVERY_LAW = [law for known in (LAWS | OUTSIDE).values() for law in known.values()]
FIRST_LAWS = [next(iter(known.values())) for known in (LAWS | OUTSIDE).values()]


def _world(seed: int, group: int = 0, laws: str = "development") -> DrawnWorld:
    return draw_world(machine_number(seed, group, laws))


def _motions(world: DrawnWorld, cycle: float = 2.0):
    return draw_motions(world.motions, 1, world.arm.range, world.arm.speed, cycle)


def _effect(law, world: DrawnWorld, size: float, seed: int = 7) -> dict:
    n = world.arm.n
    joints = {"arm": [], "wrist": [n - 2, n - 1]}.get(law.where, [2])
    names = [world.arm.joint_names[k] for k in joints]
    return {"effect": law.effect, "law": law.name, "joints": names, "size": size, "seed": seed, "parameters": {}}


@pytest.mark.parametrize("group", range(len(CLASSES)))
def test_frictionless_torque_matches_another_librarys_inverse_dynamics(group: int, tmp_path: Path) -> None:
    from agent.robot.dynamics import Dynamics

    world = _world(1, group)
    arm = world.arm
    arm = replace(arm, described_mass=arm.mass, described_centre=arm.centre, described_inertia=arm.inertia)
    friction, servo = np.zeros_like(world.friction_rows), world.servo_rows.copy()
    friction[:, [1, 3, 5, 9]] = 1e-9, 1.0, 1e-9, 1.0
    servo[:, 6], servo[:, 5] = 1e9, 1e-9  # no lag, no counts
    world = replace(world, arm=arm, friction_rows=friction, servo_rows=servo, terms=np.zeros((0, 8)))
    robot = load_robot(str(write_description(arm, tmp_path)))
    q, qd, torque = DrawnMachine(world).run({"wide": _motions(world, 8.0)["wide"]})["wide"]
    qdd = np.gradient(qd, 1 / RATE, axis=0)
    expected = Dynamics(robot).inverse_dynamics(q, qd, qdd) + arm.rotor * qdd
    middle = slice(100, -100)
    assert np.sqrt(np.mean(((torque - expected)[middle] / arm.torque) ** 2)) < 6e-3


def test_a_seed_reproduces_machine_and_logs(tmp_path: Path) -> None:
    runs = draw_cases(6, 3, "development")
    assert runs == draw_cases(6, 3, "development")
    job = {"machine": runs[0]["machine"], "motion": runs[0]["motion"], "effects": [], "cycle": 1.0}
    first, second = (run({**job, "folder": str(tmp_path / name)}) for name in "ab")
    for a, b in zip(first["logs"], second["logs"], strict=True):
        assert Path(a).read_bytes() == Path(b).read_bytes()


def test_development_and_judgement_draws_are_disjoint() -> None:
    reserved = {(law.effect, law.name) for law in EVERY_LAW if law.reserved}
    drawn = {
        laws: [r for seed in range(3) for r in draw_cases(100, seed, laws)] for laws in ("development", "judgement")
    }
    used = {
        laws: {(effect["effect"], effect["law"]) for r in runs for effect in r["effects"]}
        for laws, runs in drawn.items()
    }
    assert not used["development"] & reserved
    assert used["judgement"] & reserved
    for key in ("machine", "motion"):
        there, here = ({r[key] for r in runs} for runs in drawn.values())
        assert not there & here
        assert {number % 2 for number in there} == {0}


def test_every_effect_has_three_development_laws() -> None:
    assert set(LAWS) == set(EFFECTS)
    for effect, known in LAWS.items():
        assert sum(not law.reserved for law in known.values()) >= 3, effect
    assert sum(any(not law.reserved for law in known.values()) for known in OUTSIDE.values()) >= 8
    assert not set(OUTSIDE) & set(EFFECTS)


def test_draws_cover_all_options_including_pairs_on_one_joint() -> None:
    runs = [r for seed in range(4) for r in draw_cases(100, seed, "development")]
    worlds = [draw_world(machine) for machine in {r["machine"] for r in runs}]
    assert {world.friction for world in worlds} == set(FRICTION)
    assert {world.arm.kind.name for world in worlds} == {kind.name for kind in CLASSES}
    assert {world.velocity for world in worlds} == {"exact", "lagged", "missing"}
    assert len({world.rate for world in worlds}) == 6
    assert 0.3 < np.mean([world.recorder == "clean" for world in worlds]) < 0.7
    assert {effect["effect"] for r in runs for effect in r["effects"]} >= set(LAWS)
    several = [[tuple(e["joints"]) for e in r["effects"] if e["joints"]] for r in runs if r["kind"] in ("two", "three")]
    assert any(len(set(joints)) < len(joints) for joints in several)


@pytest.fixture(scope="module")
def healthy():
    """A world, one cycle of a motion, and the healthy machine on it."""
    world = _world(1, 1)
    motions = {"moves": tuple(part[: len(part) // 2] for part in _motions(world)["moves"])}
    return world, motions, build(world, (), 1).run(motions)


@pytest.mark.parametrize(
    "law",
    [pytest.param(law, marks=() if law in FIRST_LAWS else pytest.mark.verify) for law in EVERY_LAW],
    ids=lambda law: f"{law.effect}-{law.name}",
)
def test_an_effect_has_the_requested_size(law, healthy) -> None:
    world, motions, plain = healthy
    replaced = ("backlash", "lopsided_backlash", "joint_elasticity", "presliding")  # other springs than the machine's
    if law.effect not in replaced:
        none = build(world, [{**_effect(law, world, 0.0), "parameters": {"amount": 1e-9}}], 1).run(motions)
        assert largest_change(none, plain, world.arm.torque) < 2e-3
    found = sized(world, _effect(law, world, 0.01), 1, motions)
    reached = abs(np.log(found["found"] / 0.01)) < 0.2
    assert reached or found["parameters"]["amount"] == pytest.approx(law.highest)
    assert all(np.isfinite(signals).all() for signals in build(world, [found], 1).run(motions).values())


def test_without_effects_only_the_day_changes_the_logs_slightly() -> None:
    world = _world(2)
    motions = {"moves": _motions(world)["moves"]}
    today, again, tomorrow = (build(world, (), day).run(motions)["moves"] for day in (1, 1, 2))
    assert np.array_equal(today, again)
    change = largest_change({"moves": tomorrow}, {"moves": today}, world.arm.torque)
    assert 1e-4 < change < 0.01


def test_an_effect_without_a_law_is_refused() -> None:
    with pytest.raises(ValueError, match="no law None for the effect 'rust'"):
        build(_world(1), [{"effect": "rust", "joints": [], "seed": 1, "parameters": {}}], 1)


def test_recorders_drop_rows_round_and_delay_stamps(tmp_path: Path) -> None:
    number = next(
        m
        for m in (machine_number(seed, 0, "development") for seed in range(300))
        if {"rounded", "lossy", "late"} <= set(draw_world(m).faults) and draw_world(m).rate == 250.0
    )
    answer = run(
        {"machine": number, "motion": 3, "effects": [], "folder": tmp_path, "cycle": 1.0, "describe": tmp_path}
    )
    assert answer["size"] is None
    log = read_log(Path(answer["logs"][0]), load_robot(str(tmp_path / "robot.yaml")))
    assert np.allclose(log.position * 1e4, np.round(log.position * 1e4), atol=1e-6)
    assert np.std(np.diff(log.t)) > 1e-5


def test_placeholder_masses_are_equal(tmp_path: Path) -> None:
    arms = (_world(seed).arm for seed in range(60))
    arm = next(arm for arm in arms if len(set(arm.described_mass)) == 1)
    write_description(arm, tmp_path)
    assert len(set(re.findall('mass value="(.*?)"', (tmp_path / "arm.urdf").read_text()))) == 1


@pytest.mark.parametrize("law", LAWS["interpolator_mismatch"].values(), ids=lambda law: law.name)
def test_a_path_effect_keeps_the_duration_and_has_no_torque_size(law, tmp_path: Path) -> None:
    machine = next(m for m in (machine_number(seed, 0, "development") for seed in range(99)) if draw_world(m).tracking)
    effects = [_effect(law, draw_world(machine), 0.02)]
    job = {"machine": machine, "motion": 4, "cycle": 0.8}
    healthy = run({**job, "effects": [], "folder": tmp_path / "healthy"})
    other = run({**job, "effects": effects, "folder": tmp_path / "other"})
    assert other["size"] is None
    for plain, changed in zip(healthy["logs"], other["logs"], strict=True):
        here, there = read_log(Path(changed)), read_log(Path(plain))
        assert len(here.t) == len(there.t)
        assert here.planned_position == pytest.approx(there.planned_position)
        assert here.reference_position != pytest.approx(here.planned_position)


@pytest.mark.parametrize("command", [[], ["draw", "1", "1"], ["paint"]])
def test_another_command_is_refused(command: list[str], capsys) -> None:
    assert main(command) == 2
    assert "draw or run" in capsys.readouterr().err


def test_the_blind_check_uses_this_world_without_revealing_it_in_logs(tmp_path: Path) -> None:
    world = SecondWorld(0.5)
    drawn = world.draw(12, 2, "development")
    truth = next(truth for truth in drawn if truth["kind"] == "one")
    assert min(truth["machine"] for truth in drawn) > 2**32
    said = world.write(truth, tmp_path)
    assert said["size"] > 0
    assert [effect["found"] for effect in said["effects"]] == [pytest.approx(said["size"])]
    names = ["moves.mcap", "slow.mcap", "wide.mcap"]
    assert {path.name for path in (tmp_path / "baseline").iterdir()} >= set(names)
    logs = sorted((tmp_path / "logs").iterdir())
    assert [log.name for log in logs] == names
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
    assert main(["draw"]) == 2
    assert "pip install 'calibration-agent[mujoco]'" in capsys.readouterr().err


@pytest.mark.verify
def test_diagnoses_eight_runs_and_scores_them_by_recorder(tmp_path: Path) -> None:
    scores = BlindCheck(SecondWorld(), 8, tmp_path).run(Console(verbosity=-1))["tools"]["agent diagnose"]
    assert scores["runs"] == 8
    assert scores["recorders"]


def test_each_blind_check_case_has_its_own_machine_and_record() -> None:
    cases = draw_cases(40, 2, "judgement")
    assert [case["number"] for case in cases] == list(range(40))
    assert Counter(case["kind"] for case in cases) == {"none": 13, "two": 5, "three": 2, "outside": 5, "one": 15}
    assert len({case["machine"] for case in cases}) == 40
    assert min(case["machine"] for case in cases) > 2**50, "too many to try"
    assert {case["world"]["laws"] for case in cases} == {"judgement"}
    assert json.loads(json.dumps(cases)) == cases
