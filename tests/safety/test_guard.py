"""Conditions before an arm moves: the real driver on a real socket, a controller that obeys (conftest).

Nothing of the agent is replaced. `tests/safety/mutation.py` takes the checks of the layer away one at a time and sees
that a test of a file `test_guard*.py` fails.
"""

import hashlib
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from agent.core.errors import ControllerError, InputError, SafetyError
from agent.safety.planned_program import PlannedProgram
from drivers.errors import DriverError
from drivers.transports.tcp.driver import TcpDriver
from tests.safety.following import HOME


def test_a_valid_program_runs_once_to_its_end(bench, program):
    assert bench.run(program()) == 1000
    assert (bench.guard.takes_points, bench.guard.facts) == (False, {})
    bench.close()
    assert (bench.controller.starts, bench.controller.stops) == (1, 0)
    assert bench.warned == []


def test_refuses_a_program_without_frames_if_the_link_reads_none(bench, program):
    with pytest.raises(InputError, match=r"does not set \$TOOL"):
        bench.run(replace(program(), frames={"$TOOL": np.eye(4)}))
    assert bench.controller.starts == 0


def test_an_error_of_the_driver_is_followed_by_what_to_do(bench):
    class Asking(TcpDriver):
        def connect(self):
            raise DriverError("nobody answers; is the port right?")

    bench.driver = Asking
    with pytest.raises(DriverError, match=r"is the port right\? Put that right, then run the command again$"):
        bench.open()


def test_checks_readiness_right_before_the_start(bench, program):
    """Between the last look and the start there is no other request."""
    bench.run(program())
    assert bench.controller.asked.count("AskStatus") >= 3
    assert "UploadEnd" in bench.controller.asked
    after = bench.controller.asked[bench.controller.asked.index("UploadEnd") + 1 :]
    assert after[:2] == ["AskStatus", "AskStatus"]


@pytest.mark.parametrize(
    ("told", "error", "said"),
    [
        ({"robot": "comau_smart5"}, ControllerError, "drives 'comau_smart5'"),
        ({"joints": tuple(f"joint_{k}" for k in range(1, 6))}, ControllerError, "5 joints"),
        ({"period": 0.004}, ControllerError, "every 4 ms"),
        ({"period": 0.0}, ControllerError, "every 0 ms"),
    ],
)
def test_refuses_another_robot_or_serial(bench, told, error, said):
    bench.controller = replace(bench.controller, **told)
    with pytest.raises(error, match=said):
        bench.open()


@pytest.mark.parametrize(
    ("state", "error", "said"),
    [
        ({"emergency_stop": True}, SafetyError, "emergency stop"),
        ({"mode": "teach"}, ControllerError, "selector to auto"),
        ({"drives_on": False}, ControllerError, "drives are off"),
        ({"alarms": ("4711",)}, ControllerError, "4711"),
        ({"cell_closed": False}, ControllerError, "close the gate"),
        ({"override": 0.5}, ControllerError, "50 %"),
        ({"override": 1.5}, ControllerError, "150 %"),
        ({"moving": True}, ControllerError, "moving already"),
        ({"position": tuple(HOME + 0.03)}, ControllerError, "does not stand where its plan begins"),
    ],
)
def test_refuses_to_start_in_any_forbidden_state(bench, state, error, said, program):
    bench.controller.status = state
    guard = bench.open()
    with pytest.raises(error, match=said):
        guard.send(program())
    with pytest.raises(error, match=said), guard.motion(program()):
        pass
    assert bench.controller.starts == 0


@pytest.mark.parametrize("position", [(), (0.1,) * 5, (0.1,) * 7, (*(0.1,) * 5, np.nan), (np.nan,) * 6])
def test_refuses_to_start_with_a_wrong_number_of_joints(bench, program, position: tuple[float, ...]):
    bench.controller.status, joints = {"position": position}, sum(x == x for x in position)
    guard = bench.open()
    with pytest.raises(ControllerError, match=f"where its 6 joints stand .it tells {joints} numbers"):
        guard.position()
    with pytest.raises(ControllerError, match="where its 6 joints stand"):
        guard.send(program())
    assert bench.controller.starts == 0


def test_accepts_a_small_sag_from_the_start_position(bench, program):
    bench.controller.status = {"position": tuple(HOME + 0.015)}
    assert bench.run(program()) == 1000


def test_refuses_a_program_stored_with_another_text(bench, program):
    bench.controller.stores = hashlib.sha256(b"other").hexdigest()
    with pytest.raises(ControllerError, match="stored another text"):
        bench.run(program())
    assert bench.controller.starts == 0


def test_refuses_a_program_exchanged_after_upload(bench, program):
    guard = bench.open()
    guard.send(program())
    other = PlannedProgram("swing", "PROGRAM other", program().chains)
    with pytest.raises(ControllerError, match="stored program"), guard.motion(other):
        pass
    assert bench.controller.starts == 0


@pytest.mark.parametrize(
    ("column", "value", "said"),
    [
        ("q", np.nan, "no numbers"),
        ("qd", np.inf, "no numbers"),
        ("q", 9.0, "joint_3 would leave the position limits"),
        ("q", -9.0, "joint_3 would leave the position limits"),
        ("qd", 9.0, "joint_3 would leave the speed limit"),
        ("qd", -9.0, "joint_3 would leave the speed limit"),
    ],
)
def test_refuses_a_plan_that_violates_a_limit(bench, column, value, said, program):
    array = getattr(program().chains[0], column).copy()
    array[200, 2] = value
    with pytest.raises(InputError, match=said):
        bench.run(program(**{column: array}))
    assert bench.controller.starts == 0


def test_a_program_without_motion_has_no_start_position(bench):
    bench.controller.status = {"position": tuple(HOME + 1.0)}
    bench.controller.moves = lambda times: np.tile(HOME + 1.0, (len(times), 1))
    assert bench.run(PlannedProgram("swing", "PROGRAM swing", ())) == 1000


def test_stops_unplanned_motion(bench):
    with pytest.raises(SafetyError, match="what moves is not what was planned"):
        bench.run(PlannedProgram("swing", "PROGRAM swing", ()))
    assert bench.controller.stops >= 1


def test_does_not_start_if_the_operator_says_no(bench):
    with pytest.raises(InputError, match="nobody confirmed"):
        bench.open(yes=False)
    assert len(bench.asked) == 1
    assert "NS16-7" in bench.asked[0]


@pytest.mark.parametrize("before", [True, False])
def test_starts_if_the_operator_says_yes_there_or_before(bench, program, before):
    bench.answer = not before
    assert bench.run(program(), bench.open(yes=before)) == 1000
    assert len(bench.asked) == (0 if before else 1)


def test_only_a_local_emulator_needs_no_confirmation(bench):
    bench.controller.status = {"emulator": True}
    for address in ("", "localhost:9100", "[::1]:9100"):
        bench.open(yes=False, address=address).close()
    assert bench.asked == []
    for address in ("10.1.2.3:9100", "127.robots.example:9100", "/dev/ttyUSB0:115200"):
        with pytest.raises(InputError, match="nobody confirmed"):
            bench.open(yes=False, address=address)


def test_an_authorised_motion_needs_no_confirmation(bench, program, authorisation):
    chosen = program(0.8)
    bench.checked.add("NS16-7", chosen.checksum)
    assert bench.run(chosen, bench.open(yes=False, authorisation=authorisation(chosen))) == 1000
    assert bench.asked == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"robot": "other"}, "it is for other"),
        ({"serial": "NS16-8"}, "serial NS16-8"),
        ({"program": "0" * 64}, "it is for program"),
        ({"speed": 0.7}, "0.7 m/s are allowed"),
        ({"duration": 0.5}, "s are allowed"),
        ({"expires": date(2020, 1, 1)}, "it ended on"),
    ],
)
def test_an_authorisation_covers_only_what_it_states(bench, change, said, program, authorisation):
    chosen = program(0.8)
    bench.checked.add("NS16-7", chosen.checksum)
    guard = bench.open(yes=False, authorisation=authorisation(chosen, **change))
    with pytest.raises(InputError, match=said):
        bench.run(chosen, guard)
    assert bench.controller.starts == 0


def test_programmed_pauses_count_towards_the_authorised_duration(bench, program, authorisation):
    chosen = replace(program(0.8), pauses=90.0)
    bench.checked.add("NS16-7", chosen.checksum)
    with pytest.raises(InputError, match=r"takes 9\d s, 60 s are allowed"):
        bench.run(chosen, bench.open(yes=False, authorisation=authorisation(chosen, duration=60.0)))
    assert bench.controller.starts == 0


class Unguarded(TcpDriver):
    """The real driver, on a wire whose far end continues without this one."""

    def identify(self):
        return replace(super().identify(), unguarded="the published programs run on")


def test_an_unguarded_arm_moves_only_with_an_operator_present(bench, program, authorisation):
    bench.driver = Unguarded
    with pytest.raises(ControllerError, match=r"the published programs run on; somebody has to stand by"):
        bench.open(authorisation=authorisation(program()))
    assert bench.controller.starts == 0
    bench.close()
    bench.run(program())
    assert any("stay at the emergency stop" in text for text in bench.warned)
