"""Programs of a UR through the guard, on the emulator: what is refused, what is recorded, what stops the arm."""

import contextlib
import json
import re
import threading
import time

import numpy as np
import pytest

from agent.core import Console
from agent.link.record import record_program_file
from agent.motion import JointTarget, LoopProgram, Move, MoveType, create_dialect, with_frames
from agent.motion.urscript.settings import UrSettings
from agent.recipe import load_recipe
from agent.recording import read_log
from agent.robot import Tool, load_robot
from agent.runs import lock
from drivers.transports.ur.driver import UrDriver
from drivers.transports.ur.link import UrLink
from drivers.wire import ur_rtde as rtde
from fake_controller.ur import ports
from fake_controller.ur.fields import Cycles
from fake_controller.ur.ports import DashboardConnection, ScriptConnection
from fake_controller.ur.rtde import RtdeConnection
from tests.conftest import patience
from tests.link.test_ur_driver import SIMULATED, FakeUr

RECIPE = """
robot: ur5e
{tool}
controller: {{driver: ur, address: {address}}}
motion:
  speed: 200 mm/s
  fly: {{distance: 20 mm}}
  via_points: {{count: 2, like: loop.script, around: 50 mm}}
record: {{rate: {rate}, cycles: 2}}
"""
START = np.array([0.0, -1.2, 1.2, -1.5, -1.5, 0.0])
#: Of somebody else; nothing stops it but a stop.
OTHER = f"def other():\n  while True:\n    movej({(START + 0.5).tolist()})\n    movej({START.tolist()})\n  end\nend\n"


@pytest.fixture
def fake(monkeypatch, tmp_path):
    monkeypatch.setattr(lock, "FOLDERS", (tmp_path,))  # all loopback addresses are one machine, and UR's ports one
    monkeypatch.setattr(SIMULATED, min(patience(2.0), 5.0))
    with contextlib.closing(FakeUr()) as fake:
        yield fake


@pytest.fixture
def program(tmp_path):
    """There and back, twice, after a joint move to the start."""
    settings = with_frames(UrSettings(fly_distance=0.02, joint_speed=1.0), None)
    points = [
        JointTarget(START),
        JointTarget(START + [0.2, 0.1, 0, 0, 0, 0.1]),
        JointTarget(START + [0.3, 0, 0.2, 0, 0, 0]),
    ]
    loop = LoopProgram.of(points, settings.changed(linear_speed=0.1), 2, settings, JointTarget(START))
    text = create_dialect("urscript").write_loop("loop", loop, load_robot("ur5e"))
    path = tmp_path / "loop.script"
    path.write_text(text)
    return path


def record(fake, program, tool="", rate="500 Hz"):
    recipe = program.with_name("recipe.yaml")
    recipe.write_text(RECIPE.format(address=fake.address, tool=tool, rate=rate))
    return record_program_file(load_recipe(recipe), program, None, Console(-1), True, program.parent / "logs")


def test_a_program_is_recorded_with_currents_and_cycles(fake, program):
    recording = record(fake, program)
    assert (fake.cell.motions_started, recording.lost) == (1, 0)
    assert len(recording.cycle_starts) == 2
    log = read_log(recording.path, load_robot("ur5e"))
    assert log.metadata["torque_source"].startswith("motor current")
    markers = np.array(json.loads(log.metadata["cycle_markers_s"]))
    np.testing.assert_allclose(np.diff(markers), np.diff(recording.cycle_starts), atol=0.01)
    assert np.abs(log.effort).max() > 20.0
    assert recording.temperatures


def test_a_rate_that_the_controller_does_not_have_is_refused_with_both_rates(fake, program):
    with pytest.raises(Exception, match="samples every 2 ms, the recipe asks for 125 Hz") as refused:
        record(fake, program, rate="125 Hz")
    assert refused.value.exit_code == 4


def test_a_tool_that_differs_from_the_pendant_is_refused_with_both_values(fake, program):
    frame = np.eye(4)
    frame[2, 3] = 0.12
    settings = with_frames(UrSettings(), Tool(frame, 1.2, np.zeros(3)))
    move = Move(MoveType.JOINT, JointTarget(START), settings)
    program.write_text(create_dialect("urscript").write("tool", [move]))
    with pytest.raises(Exception, match=r"TCP at the pendant is \[0, 0, 0, .*\[0, 0, 0.12, ") as refused:
        record(fake, program, "tool: {frame: [0 mm, 0 mm, 120 mm, 0 deg, 0 deg, 0 deg], mass: 1.2 kg}")
    assert refused.value.exit_code == 4
    assert fake.cell.motions_started == 0


def replaced(monkeypatch, fake, moment):
    """Somebody else's script comes just before the permit is given, or once our program waits for it."""
    if moment == "permit":
        allow = UrLink.allow

        def also(link, number):
            if number:
                fake.cell.take_script(OTHER)
            allow(link, number)

        monkeypatch.setattr(UrLink, "allow", also)
    else:
        see = UrDriver._see_program

        def first(driver, link, motion, program):
            link.wait(lambda: link.latest[rtde.RUNNING] == program.number, 5.0)
            fake.cell.take_script(OTHER)
            link.wait(lambda: link.latest[rtde.RUNNING] != program.number, 0.5)
            see(driver, link, motion, program)

        monkeypatch.setattr(UrDriver, "_see_program", first)


@pytest.mark.parametrize(
    ("moment", "told", "said"),
    [
        ("wait", False, "moved before the program that was sent was allowed to"),
        ("permit", True, "program other was started at the controller and replaced"),
        ("permit", False, "not what was planned"),
    ],
)
def test_another_script_during_the_start_is_stopped(program, monkeypatch, tmp_path, moment, told, said, capsys):
    """Its samples are in a log, whose name is said; nobody says that nothing moved. The controller may tell of it."""
    monkeypatch.setattr(lock, "FOLDERS", (tmp_path,))
    with contextlib.closing(FakeUr("real")) as fake:
        if not told:
            tell = fake.cell._tell
            monkeypatch.setattr(fake.cell, "_tell", lambda message: None if b"other" in message else tell(message))
        replaced(monkeypatch, fake, moment)
        with pytest.raises(Exception, match=said) as stopped:
            record(fake, program)
        assert stopped.value.exit_code == 5
        assert "nothing moved" not in str(stopped.value)
        assert fake.wait(patience(5.0))
        assert not fake.cell.running
    log = read_log(program.with_suffix(".mcap"), load_robot("ur5e"))
    moved = np.flatnonzero(np.any(np.abs(log.position - log.position[0]) > 1e-3, axis=1))
    assert len(moved)
    assert log.t[-1] - log.t[moved[0]] < patience(2.5), "it was followed to the end of the driver's patience"
    assert "loop.mcap: holds the " in capsys.readouterr().err


def test_the_payload_of_the_pendant_is_restored(fake, program):
    """Its inertia too, which the program does not know."""
    before = [0.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.03, 0.0, 0.0, 0.001]
    fake.cell.payload = list(before)
    seen = []
    fake.on_moving = lambda: seen.append(list(fake.cell.payload))
    record(fake, program)
    assert seen == [[0.0] * 10]
    until = time.monotonic() + patience(5.0)
    while fake.cell.payload != before and time.monotonic() < until:
        time.sleep(0.001)
    assert fake.cell.payload == before


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("payload", [2.5, 0.0, 0.0, 0.07, *[0.0] * 6], "the payload was set anew .* to 2.500 kg at [0, 0, 0.07]"),
        ("tcp", np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]]), "the TCP was set anew"),
    ],
)
def test_what_is_set_anew_at_the_controller_in_motion_is_told_and_noted(fake, program, capsys, name, value, said):
    program.write_text(program.read_text().replace("while i < 2:", "while i < 6:"))
    fake.on_moving = lambda: setattr(fake.cell, name, value)
    recording = record(fake, program)
    (change,) = json.loads(read_log(recording.path, load_robot("ur5e")).metadata["controller_changes"])
    assert change["setting"].lower() == name
    assert change["before"] != change["after"]
    assert change["time_s"] > 0.0
    assert re.search(said.replace("[", r"\["), " ".join(capsys.readouterr().err.split()))
    assert np.array_equal(getattr(fake.cell, name), value), "somebody else's setting is not undone"


def told(monkeypatch, fake, name, value):
    """A field of RTDE has this value from now on."""
    truth = Cycles.field
    monkeypatch.setattr(Cycles, "field", lambda cycles, asked: value if asked == name else truth(cycles, asked))


def lose(fake, kind):
    """All connections of a port close."""
    for client in [one for one in fake._clients if isinstance(one, kind)]:
        client.close()


def skip(fake):
    """Three of four samples are not sent any more."""
    for client in [one for one in fake._clients if isinstance(one, RtdeConnection)]:
        client._every = 4


@pytest.mark.parametrize(
    ("prepare", "message"),
    [
        (lambda fake, _: setattr(fake.cell.state, "override", 0.5), r"override is 50 %"),
        (lambda fake, _: fake.cell.protective_stop("a test"), "PROTECTIVE_STOP"),
        (lambda fake, _: setattr(fake.cell.state, "mode", "teach"), "mode is 'teach'"),
        (lambda fake, _: setattr(fake.cell, "model", "UR10"), "ur10e.*ur5e|ur5e.*ur10e"),
        (lambda fake, patch: told(patch, fake, "actual_q", np.full(6, np.nan)), "positions that are no numbers"),
        (lambda fake, patch: told(patch, fake, "target_speed_fraction", np.nan), "override is nan"),
        (lambda fake, patch: told(patch, fake, "timestamp", np.nan), "clock .* jumped"),
        (lambda fake, patch: told(patch, fake, "timestamp", 70.0), "clock of the controller stands still"),
    ],
)
def test_a_wrong_state_is_refused_before_motion(fake, program, monkeypatch, prepare, message):
    prepare(fake, monkeypatch)
    with pytest.raises(Exception, match=message) as refused:
        record(fake, program)
    assert refused.value.exit_code == 4
    assert fake.cell.motions_started == 0


@pytest.mark.parametrize(
    ("happens", "message", "code"),
    [
        (lambda fake, _: fake.cell.protective_stop("it touched something"), "PROTECTIVE_STOP", 5),
        (lambda fake, _: setattr(fake.cell.state, "override", 0.4), "override", 5),
        (lambda fake, _: fake.cell.pause(True), "paused", 5),
        (lambda fake, _: setattr(fake.cell.state, "mode", "teach"), "mode was changed to 'teach'", 5),
        (lambda fake, patch: told(patch, fake, "safety_mode", 99), "safety mode 99", 5),
        (lambda fake, patch: told(patch, fake, "actual_q", np.full(6, np.nan)), "positions that are no numbers", 5),
        (lambda fake, patch: told(patch, fake, "target_q", np.full(6, np.nan)), "set-points that are no numbers", 5),
        (lambda fake, patch: told(patch, fake, "target_speed_fraction", np.nan), "override was changed to nan", 5),
        (lambda fake, patch: told(patch, fake, "timestamp", np.nan), "clock .* jumped", 4),
        (lambda fake, _: lose(fake, ScriptConnection), "closed the primary interface.*sure that the arm rests", 4),
        (lambda fake, _: lose(fake, DashboardConnection), "dashboard at .* closed the connection", 4),
        (lambda fake, _: skip(fake), "of the last .* samples", 4),
        (lambda fake, _: fake.cell.take_script(OTHER), "program other was started at the controller", 5),
        (
            lambda fake, patch: (
                patch.setitem(ports._ANSWERS, "stop", ((0,), "Stopped")),
                fake.cell.take_script(OTHER),
            ),
            "program other was started at the controller",
            5,
        ),
    ],
)
def test_a_fault_in_motion_stops_the_arm_and_is_reported(fake, program, monkeypatch, happens, message, code):
    fake.on_moving = lambda: threading.Thread(target=happens, args=(fake, monkeypatch)).start()
    program.write_text(program.read_text().replace("while i < 2:", "while i < 200:"))
    with pytest.raises(Exception, match=message) as stopped:
        record(fake, program)
    assert stopped.value.exit_code == code
    assert fake.wait(5.0)
    assert not fake.cell.running
    assert read_log(program.with_suffix(".mcap"), load_robot("ur5e")).position.shape[1] == 6
