"""Dashboard, script ports and what they send."""

import struct
from threading import Event, Thread

import numpy as np
import pytest

from fake_controller.faults import Fault
from fake_controller.ur.messages import key_message, text_message
from fake_controller.ur.ports import ScriptConnection
from tests.ur_fake.clients import PATIENCE, Dashboard, Primary, Wire, clients, program, texts, three, turn, warnings
from tests.ur_fake.conftest import CB3

REFUSED = (
    "Command is not allowed due to safety reasons, "
    "please switch robot to Remote Control mode and reconnect to port 29999"
)


def test_messages_have_the_published_bytes():
    assert text_message(1.5, "hi") == bytes.fromhex("00000011 14 000000000016e360 fe 00") + b"hi"
    started = bytes.fromhex("0000002e 14 0000000000000000 fe 07 00000000 00000000 13") + b"PROGRAM_XXX_STARTEDjob"
    assert key_message(0.0, "PROGRAM_XXX_STARTED", "job") == started


def test_the_primary_says_who_it_is_and_what_the_arm_is(start_ur):
    ur = start_ur()
    with clients(Primary(ur.address)) as client:
        kind, version = client.version
        assert kind == 3
        assert version[:10] == b"\x09URControl"
        assert struct.unpack(">BBii", version[10:20]) == (5, 12, 6, 1102099)
        parts = client.state()
    mode = parts[0]
    assert struct.unpack(">7?bB", mode[8:17]) == (False, True, True, False, False, False, False, 7, 0)
    assert struct.unpack(">ddd", mode[17:41]) == (1.0, 1.0, 1.0)
    assert len(parts[1]) == 251 - 5
    first = struct.unpack(">dddffffB", parts[1][:41])
    np.testing.assert_allclose(first[0], first[1], atol=1e-3)
    assert first[-1] == 253
    kinematics = np.frombuffer(parts[5][24:-4], ">f8").reshape(4, 6)  # theta, a, d, alpha
    assert 1e-6 < np.abs(kinematics[1] - [0, -0.425, -0.3922, 0, 0, 0]).max() < 2e-3
    configuration = np.frombuffer(parts[6][:-16], ">f8")
    np.testing.assert_allclose(configuration[:12], np.tile([-2 * np.pi, 2 * np.pi], 6))
    np.testing.assert_allclose(configuration[12:24:2], np.pi)
    np.testing.assert_array_equal(
        configuration[29:41], [0, -0.425, -0.3922, 0, 0, 0, 0.1625, 0, 0, 0.1333, 0.0997, 0.0996]
    )
    assert struct.unpack(">4i", parts[6][-16:])[2] == 1  # a UR5


def test_the_dashboard_answers_as_published(ur):
    with clients(Dashboard(ur)) as client:
        assert client.greeting == "Connected: Universal Robots Dashboard Server"
        assert client.ask("PolyscopeVersion").startswith("URSoftware 5.12.6.1102099 (")
        assert client.ask("get serial number").isdigit()
        answers = {
            "get robot model": "UR5",
            "robotmode": "Robotmode: RUNNING",
            "safetystatus": "Safetystatus: NORMAL",
            "safetymode": "Safetymode: NORMAL",
            "is in remote control": "true",
            "running": "Program running: false",
            "get loaded program": "No program loaded",
            "load x.urp": "File not found: x.urp",
            "play": "Failed to execute: play",
            "stop": "Failed to execute: stop",
            "power off": "Powering off",
            "quit": "Disconnected",
        }
        assert {command: client.ask(command) for command in answers} == answers


def test_powering_takes_two_steps(ur):
    with clients(Dashboard(ur)) as client:
        modes = []
        for command in ("power off", "power on", "brake release"):
            client.ask(command)
            modes.append(client.ask("robotmode"))
    assert modes == ["Robotmode: POWER_OFF", "Robotmode: IDLE", "Robotmode: RUNNING"]


def test_a_cb3_has_no_remote_mode(start_ur):
    with clients(Dashboard(start_ur(version=CB3).address)) as client:
        assert client.ask("PolyscopeVersion").startswith("URSoftware 3.15.8")
        for command in ("is in remote control", "safetystatus", "get operational mode"):
            assert client.ask(command).startswith("Could not understand")


def test_local_mode_refuses_and_a_reconnection_is_needed(start_ur, monkeypatch):
    ur, taken = start_ur(), Event()
    take_script = ur.cell.take_script
    monkeypatch.setattr(ur.cell, "take_script", lambda script: (take_script(script), taken.set()))
    with clients(Dashboard(ur.address), Primary(ur.address)) as (old, remote):
        ur.cell.state.mode = "teach"
        assert old.ask("is in remote control") == "false"
        for command in ("play", "stop", "power off", "unlock protective stop"):
            assert old.ask(command) == REFUSED
        remote.send(program('textmsg("silent")').encode())  # ignored
        assert taken.wait(PATIENCE)
        with clients(Primary(ur.address)) as local:
            local.send(program('textmsg("silent")').encode())
            assert warnings([local.message()])[0][0] == 210
        ur.cell.state.mode = "auto"
        assert old.ask("stop") == "Failed to execute: stop"  # it was in remote mode when this client came
        remote.send(program('textmsg("heard")').encode())
        assert texts(remote.ended()) == ["heard"]


def test_turning_the_robot_local_closes_script_ports(start_ur):
    ur = start_ur(faults=[Fault("teach_mode", "streaming", 0.1)])
    with clients(Primary(ur.address)) as client:
        client.send(program(turn(ur, 0.02)).encode())
        with pytest.raises(EOFError):
            client.until_closed()


def test_a_line_that_is_no_script_is_executed_at_once(ur):
    with clients(Primary(ur), Dashboard(ur)) as (primary, dashboard):
        primary.send(b"power off\n")
        while dashboard.ask("robotmode") != "Robotmode: POWER_OFF":
            pass
        primary.send(b"power on\nset robotmode run\n")
        while dashboard.ask("robotmode") != "Robotmode: RUNNING":
            pass
        primary.send(program("sleep(100)").encode())
        assert primary.message()[1].endswith(b"STARTEDjob")
        primary.send(b"stop program\n")
        assert primary.message()[1].endswith(b"STOPPEDjob")


@pytest.mark.parametrize("port", [30001, 30002, 30003])
def test_three_ports_accept_scripts(ur, port):
    with clients(Primary(ur)) as primary:
        for script, said in ((program('textmsg("here")').encode(), "here"), (b'textmsg("alone")\n', "alone")):
            with clients(Wire(ur, port)) as client:  # anew: who reads nothing is dropped after a while
                client.send(script)
                assert texts(primary.ended()) == [said]


def test_who_has_read_the_version_misses_nothing(start_ur, monkeypatch):
    """As where the thread that greets a client is held up right after it."""
    say, message = ScriptConnection.say, text_message(0.0, "said at once")

    def held_up(self, data, waits=False):
        say(self, data, waits)
        if b"URControl" in data:
            told = Thread(target=lambda: [listener.on_message(message) for listener in list(self.cell.listeners)])
            told.start()
            told.join(0.1)

    monkeypatch.setattr(ScriptConnection, "say", held_up)
    with clients(Primary(start_ur().address)) as primary:
        assert texts([primary.message()]) == ["said at once"]


def test_a_program_replaces_the_one_that_runs(ur):
    with clients(Primary(ur)) as client:
        client.send(program("sleep(1000)", name="first").encode())
        assert client.message()[1].endswith(b"PROGRAM_XXX_STARTEDfirst")
        client.send(program('textmsg("now me")', name="second").encode())
        said = [client.message() for _ in range(4)]
    assert [content[-6:] for _, content in said] == [b"Dfirst", b"second", b"now me", b"second"]


def test_a_protective_stop_can_be_unlocked_after_five_seconds(start_ur):
    ur = start_ur(faults=[Fault("protective_stop", "streaming", 0.2)])
    with three(ur, "timestamp", "safety_mode", "runtime_state") as (primary, dashboard, rtde):
        primary.send(program(turn(ur, 0.5), 'textmsg("went on")').encode())
        stopped = rtde.until(lambda sample: sample["safety_mode"] == 3)[-1]
        assert stopped["runtime_state"] in (3, 4)
        assert dashboard.ask("unlock protective stop").startswith("Cannot unlock")
        assert dashboard.ask("play") == "Failed to execute: play"
        rtde.until(lambda sample: sample["timestamp"] > stopped["timestamp"] + 5.1)
        assert dashboard.ask("unlock protective stop") == "Protective stop releasing"
        assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"
        assert dashboard.ask("play") == "Starting program"
        assert texts(primary.ended()) == ["went on"]


@pytest.mark.parametrize(
    ("fault", "mode", "word"), [("emergency_stop", 7, "ROBOT_EMERGENCY_STOP"), ("drive_fault", 9, "FAULT")]
)
def test_a_fault_ends_the_program_and_shows_in_the_state(start_ur, fault, mode, word):
    ur = start_ur(faults=[Fault(fault, "streaming", 0.1)])
    with three(ur, "safety_mode", "robot_mode", "runtime_state") as (primary, dashboard, rtde):
        primary.send(program(turn(ur, 0.02)).encode())
        sample = rtde.until(lambda sample: sample["safety_mode"] == mode and sample["runtime_state"] == 1)[-1]
        assert sample["robot_mode"] == 3
        assert dashboard.ask("safetystatus") == f"Safetystatus: {word}"
        primary.send(program('textmsg("no")').encode())
        assert warnings(primary.ended()[-1:] + [primary.message()])[-1][0] == 210
