"""The safety layer between pipeline and driver: the real driver on a real socket, a controller that does as told.

The peer at the far end answers what a test wants it to; nothing of the agent is replaced. `tests/safety/mutation.py`
takes the checks of the layer away one at a time and sees that one of these tests fails.
"""

from __future__ import annotations

import hashlib
import json
import socket
import threading
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from pathlib import Path

import numpy as np
import pytest

from agent.errors import AgentError, ControllerError, InputError, SafetyError
from agent.motion.program import Delay, JointTarget, MotionSettings, Move, MoveType
from agent.motion.trajectory import Trajectory
from agent.robot import load_robot
from agent.safety.authorisation import Authorisation
from agent.safety.checked import CheckedPrograms
from agent.safety.first_run import FIRST_SPEED, slow_version, stop_to_stop
from agent.safety.guard import GuardedLink
from agent.safety.motion import PlannedProgram
from drivers.errors import DriverError, MotionStopped, RefusedError
from drivers.tcp import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import EndReason, Refusal

HOME = np.radians([0.0, 0.0, -90.0, 0.0, 0.0, 0.0])
NAMES = tuple(f"joint_{k}" for k in range(1, 7))


def trajectory(speed: float = 0.1, start: np.ndarray = HOME, seconds: float = 1.0) -> Trajectory:
    """A small swing of every joint; `speed` is what it says of its tool centre point."""
    t = np.arange(0.0, seconds, 0.002)
    swing = 0.05 * (1 - np.cos(2 * np.pi * t / seconds))[:, None]
    rate = np.gradient(swing, 0.002, axis=0)
    q, qd = start + swing * np.ones(6), rate * np.ones(6)
    poses = np.repeat(np.eye(4)[None], len(t), axis=0)
    return Trajectory(t, q, qd, np.zeros_like(q), poses, np.full(len(t), speed), np.zeros(len(t), int))


def program(speed: float = 0.1, **changes: object) -> PlannedProgram:
    return PlannedProgram("swing", "PROGRAM swing", (replace(trajectory(speed), **changes),))


@dataclass
class Controller:
    """What the peer says of itself, and what it was asked to do."""

    robot: str = "comau_ns16"
    serial: str = "NS16-7"
    joints: tuple[str, ...] = NAMES
    period: float = 0.002
    stores: str = ""  # checksum it claims for every program
    refuses: Refusal | None = None
    lose_answer: bool = False
    confirms_stop: bool = True
    blocks: int = 10
    end: EndReason = EndReason.DONE
    vanish_after: int = -1
    status: dict = field(default_factory=dict)
    later: dict = field(default_factory=dict)  # state from the third block on
    status_fails_later: bool = False
    pushes: bool = False  # all blocks at once, not one a look
    spacing: int = 2_500_000  # of the samples [ns]
    starts: int = 0
    stops: int = 0
    asked: list[str] = field(default_factory=list)

    def answer(self, message: object, state: dict) -> object:
        self.asked.append(type(message).__name__)
        match message:
            case tcp.Hello():
                return tcp.Welcome(tcp.VERSION, 2000)
            case tcp.Identify():
                return tcp.IdentityReply(self.robot, self.serial, "peer", "1", self.joints, self.period)
            case tcp.AskStatus():
                return tcp.StatusReply(**state)
            case tcp.UploadBegin(name, _, checksum):
                state |= {"program": name, "checksum": self.stores or checksum}
                return tcp.Done()
            case tcp.UploadEnd():
                return tcp.Stored("swing", self.stores or state["checksum"])
            case _:
                return tcp.Done()


class Peer(threading.Thread):
    """Serves one client."""

    def __init__(self, controller: Controller):
        super().__init__(daemon=True)
        self.controller = controller
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        self.start()

    def run(self) -> None:
        try:
            connection, _ = self.listener.accept()
        except OSError:
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with connection, suppress(OSError):
            self._serve(connection)

    def _serve(self, connection: socket.socket) -> None:
        told, decoder = self.controller, tcp.Decoder(tcp.MAX_REQUEST_PAYLOAD)
        state = {
            "drives_on": True,
            "mode": "auto",
            "emergency_stop": False,
            "alarms": (),
            "override": 1.0,
            "cell_closed": True,
            "moving": False,
            "program": "",
            "checksum": "",
            "position": tuple(HOME),
            "emulator": False,
            **told.status,
        }
        sent, running = 0, False

        def send(message: object, request: int = 0) -> None:
            connection.sendall(tcp.encode(message, request))

        def block() -> None:
            nonlocal sent, running
            first = 100 * sent
            values = np.zeros((100, 6))
            stamps = (first + np.arange(100)) * told.spacing  # at first, a block is a quarter of a second
            send(tcp.Samples(first, stamps.astype(np.int64), *(values for _ in range(5))))
            sent += 1
            if sent == 3:
                state.update(told.later)
            if sent == told.vanish_after:
                connection.shutdown(socket.SHUT_RDWR)
            elif sent == told.blocks:
                running = False
                send(tcp.End(told.end, 100 * sent, "as told"))

        while data := connection.recv(65536):
            for frame in decoder.feed(data):
                message = tcp.decode(frame)
                if isinstance(message, tcp.Heartbeat):
                    continue
                if isinstance(message, tcp.Start):
                    told.starts += 1
                    if told.lose_answer:
                        connection.shutdown(socket.SHUT_RDWR)
                        return
                    if told.refuses is not None:
                        send(tcp.Refused(told.refuses, 0, 0, "as told"), frame.request)
                        continue
                    send(tcp.Started(message.motion_id), frame.request)
                    running = True
                    for _ in range(told.blocks if told.pushes else 1):
                        block()
                elif isinstance(message, tcp.Stop):
                    told.stops += 1
                    if not told.confirms_stop:
                        send(tcp.Refused(Refusal.INTERNAL, 0, 0, "no"), frame.request)
                        continue
                    send(tcp.Done(), frame.request)
                    if running:
                        running = False
                        reason = EndReason.STOPPED if told.end is EndReason.DONE else told.end
                        send(tcp.End(reason, 100 * sent, "as told"))
                elif isinstance(message, tcp.AskStatus) and running:
                    if told.status_fails_later and sent >= 3:
                        send(tcp.Refused(Refusal.INTERNAL, 0, 0, "no"), frame.request)
                    else:
                        send(told.answer(message, state), frame.request)
                    block()  # the guard looks at every block, so each look brings the next
                else:
                    send(told.answer(message, state), frame.request)


class Bench:
    """A guard in front of a peer; `asked` are the questions a person got, `warned` what was told."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.controller = Controller()
        self.robot = load_robot("comau_ns16")
        self.checked = CheckedPrograms(folder / "checked_programs.json")
        self.answer = False
        self.asked: list[str] = []
        self.warned: list[str] = []
        self.guard: GuardedLink | None = None
        self.address = ""

    def build(self, yes: bool = True, address: str = "", rate: float = 500.0, **options: object) -> GuardedLink:
        peer = Peer(self.controller)
        self.address = peer.address

        def ask(question: str) -> bool:
            self.asked.append(question)
            return self.answer

        self.guard = GuardedLink(
            TcpDriver(peer.address, timeout=2.0, start_timeout=2.0),
            self.robot,
            address or peer.address,
            rate,
            self.checked,
            ask,
            self.warned.append,
            yes,
            **options,
        )
        return self.guard

    def open(self, **options: object) -> GuardedLink:
        guard = self.build(**options)
        guard.open()
        return guard

    def run(self, chosen: PlannedProgram, guard: GuardedLink | None = None) -> int:
        """Send and run; how many samples came."""
        guard = guard or self.open()
        guard.send(chosen)
        with guard.motion(chosen) as samples:
            return sum(len(block) for block in samples)

    def close(self) -> None:
        if self.guard is not None:
            self.guard.close()


@pytest.fixture
def bench(tmp_path: Path):
    with closing(Bench(tmp_path)) as bench:
        yield bench


def test_what_is_in_order_runs_once_to_its_end(bench):
    assert bench.run(program()) == 1000
    assert (bench.controller.starts, bench.controller.stops) == (1, 0)
    assert bench.warned == []


def test_readiness_is_looked_at_right_before_the_start(bench):
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
        ({"joints": NAMES[:5]}, ControllerError, "5 joints"),
        ({"period": 0.004}, ControllerError, "every 4 ms"),
        ({"period": 0.0}, ControllerError, "every 0 ms"),
    ],
)
def test_whoever_is_not_the_one_meant_is_left_alone(bench, told, error, said):
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
        ({"position": tuple(HOME + np.nan)}, ControllerError, "does not stand where its plan begins"),
    ],
)
def test_no_state_that_forbids_motion_lets_it_start(bench, state, error, said):
    bench.controller.status = state
    guard = bench.open()
    with pytest.raises(error, match=said):
        guard.send(program())
    with pytest.raises(error, match=said), guard.motion(program()):
        pass
    assert bench.controller.starts == 0


def test_a_little_sag_is_no_jog(bench):
    bench.controller.status = {"position": tuple(HOME + 0.015)}
    assert bench.run(program()) == 1000


def test_another_text_than_was_sent_does_not_run(bench):
    bench.controller.stores = hashlib.sha256(b"other").hexdigest()
    with pytest.raises(ControllerError, match="stored another text"):
        bench.run(program())
    assert bench.controller.starts == 0


def test_a_program_exchanged_after_it_was_sent_does_not_run(bench):
    guard = bench.open()
    guard.send(program())
    other = PlannedProgram("swing", "PROGRAM other", program().chains)
    with pytest.raises(ControllerError, match="stored program"), guard.motion(other):
        pass
    assert bench.controller.starts == 0


def _with(column: str, value: float) -> PlannedProgram:
    array = getattr(trajectory(), column).copy()
    array[200, 2] = value
    return program(**{column: array})


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
def test_a_plan_that_breaks_a_limit_does_not_run(bench, column, value, said):
    with pytest.raises(InputError, match=said):
        bench.run(_with(column, value))
    assert bench.controller.starts == 0


def test_a_program_that_does_not_move_has_no_place_to_start_from(bench):
    bench.controller.status = {"position": tuple(HOME + 1.0)}
    assert bench.run(PlannedProgram("swing", "PROGRAM swing", ())) == 1000


def test_a_person_is_asked_and_no_is_no(bench):
    with pytest.raises(InputError, match="nobody confirmed"):
        bench.open(yes=False)
    assert len(bench.asked) == 1
    assert "NS16-7" in bench.asked[0]


def test_a_person_is_asked_and_yes_is_yes(bench):
    bench.answer = True
    assert bench.run(program(), bench.open(yes=False)) == 1000


def test_who_said_yes_is_not_asked_again(bench):
    bench.open(yes=True)
    assert bench.asked == []


def test_only_the_emulator_on_this_machine_is_not_asked_about(bench):
    bench.controller.status = {"emulator": True}
    for address in ("", "localhost:9100", "[::1]:9100"):
        bench.open(yes=False, address=address).close()
    assert bench.asked == []
    for address in ("10.1.2.3:9100", "127.robots.example:9100", "/dev/ttyUSB0:115200"):
        with pytest.raises(InputError, match="nobody confirmed"):
            bench.open(yes=False, address=address)


def authorisation(chosen: PlannedProgram, **changes: object) -> Authorisation:
    granted = Authorisation(
        Path("word.yaml"), "comau_ns16", "NS16-7", chosen.checksum, 1.0, 60.0, date(2999, 1, 1), "M. Rossi"
    )
    return replace(granted, **changes)


def test_an_authorised_motion_needs_nobody(bench):
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
def test_an_authorisation_covers_what_it_says_and_nothing_else(bench, change, said):
    chosen = program(0.8)
    bench.checked.add("NS16-7", chosen.checksum)
    guard = bench.open(yes=False, authorisation=authorisation(chosen, **change))
    with pytest.raises(InputError, match=said):
        bench.run(chosen, guard)
    assert bench.controller.starts == 0


def test_an_authorisation_ends_at_the_end_of_its_day():
    word = authorisation(program(), expires=date(2027, 3, 31))
    facts = ("comau_ns16", "NS16-7", program().checksum, 0.5, 10.0)
    word.check(*facts, now=datetime(2027, 3, 31, 23, 59, tzinfo=UTC))
    with pytest.raises(InputError, match="it ended"):
        word.check(*facts, now=datetime(2027, 4, 1, 0, 1, tzinfo=UTC))


def test_nobody_watches_a_program_that_nobody_has_watched_before(bench):
    chosen = program(0.1)
    guard = bench.open(yes=False, authorisation=authorisation(chosen))
    with pytest.raises(InputError, match="has never run on serial NS16-7"):
        bench.run(chosen, guard)
    assert bench.controller.starts == 0


def test_a_program_that_is_new_to_a_machine_runs_slowly_first(bench):
    fast = program(0.8)
    guard = bench.open()
    assert guard.needs_slow_run(fast)
    with pytest.raises(ControllerError, match="has never run on serial NS16-7"):
        bench.run(fast, guard)
    assert bench.controller.starts == 0
    slow = replace(program(FIRST_SPEED), text="PROGRAM slow", stands_for=fast.checksum)
    assert bench.run(slow, guard) == 1000
    guard.close()
    guard = bench.open()
    assert not guard.needs_slow_run(fast)
    assert bench.run(fast, guard) == 1000
    bench.controller = Controller(serial="NS16-8")
    assert bench.open().needs_slow_run(fast), "another machine"
    assert not bench.open().needs_slow_run(slow), "no slower than slow"


def test_an_emulator_needs_no_slow_run(bench):
    bench.controller.status = {"emulator": True}
    assert bench.run(program(0.8)) == 1000
    assert bench.run(program(0.1)) == 1000
    assert not bench.checked.path.exists()


def test_a_slow_run_that_was_cut_short_does_not_count(bench):
    bench.controller.vanish_after = 4
    with pytest.raises(DriverError):
        bench.run(program(0.2))
    assert not bench.checked.has("NS16-7", program(0.2).checksum)


def test_a_slow_run_that_was_left_early_does_not_count(bench):
    guard = bench.open()
    guard.send(program())
    with guard.motion(program()) as samples:
        next(samples)
    assert bench.controller.stops == 1
    assert not bench.checked.has("NS16-7", program().checksum)


def test_a_program_that_is_slow_by_itself_counts(bench):
    assert bench.run(program(0.2)) == 1000
    assert bench.checked.has("NS16-7", program().checksum)
    assert len(json.loads(bench.checked.path.read_text(encoding="utf-8"))["programs"]) == 1


def test_the_list_of_checked_programs(tmp_path: Path):
    checked = CheckedPrograms(tmp_path / "deep" / "checked_programs.json")
    assert not checked.has("a", "p")
    checked.add("a", "p")
    checked.add("a", "p")
    checked.add("b", "q")
    again = CheckedPrograms(checked.path)
    assert again.has("a", "p")
    assert again.has("b", "q")
    assert not again.has("a", "q")
    assert len(json.loads(checked.path.read_text(encoding="utf-8"))["programs"]) == 2
    for damage in ("", "[]", '{"schema": "other", "programs": []}', '{"schema": "checked_programs/1"}'):
        checked.path.write_text(damage, encoding="utf-8")
        with pytest.raises(InputError, match="damaged"):
            again.has("a", "p")


def test_the_slow_version_is_one_turn_at_no_more_than_the_first_speed(bench):
    from agent.motion import FlyInterpolator
    from agent.motion.pdl2 import parse_program, write_program

    settings = MotionSettings().changed(linear_speed=1.0)
    targets = [JointTarget(HOME + np.radians([angle, 0, 0, 0, 0, 0])) for angle in (20.0, -20.0)]
    swing = [Move(MoveType.JOINT, target, settings) for target in targets]
    text = write_program("swing", swing * 5, bench.robot)
    interpolator = FlyInterpolator(bench.robot, period=0.002)
    slow = slow_version(PlannedProgram("swing", text, ()), bench.robot, interpolator, HOME)
    assert slow.stands_for == hashlib.sha256(text.encode()).hexdigest()
    assert 0.5 * FIRST_SPEED < slow.speed <= FIRST_SPEED
    assert len(slow.chains) == 3, "from home, there, and back: the fourth stretch would be the second again"
    planned = interpolator.plan(tuple(list(parse_program(slow.text, "slow").run())[:1]), HOME)
    np.testing.assert_allclose(planned.q[-1], targets[0].position, atol=1e-9)
    assert planned.path_speed.max() <= FIRST_SPEED


def test_every_way_is_gone_slowly_also_from_the_same_place(bench):
    from agent.motion import FlyInterpolator
    from agent.motion.pdl2 import write_program

    goals = [HOME + np.radians([angle, 0, 0, 0, 0, 0]) for angle in (5.0, 0.0, -5.0, 0.0)]
    moves = [Move(MoveType.JOINT, JointTarget(goal), MotionSettings()) for goal in goals]
    text = write_program("ways", moves * 2, bench.robot)
    interpolator = FlyInterpolator(bench.robot, period=0.002)
    slow = slow_version(PlannedProgram("ways", text, ()), bench.robot, interpolator, HOME)
    assert len(slow.chains) == 4


def test_a_program_is_cut_where_the_arm_stops():
    stop, fly = (Move(MoveType.JOINT, JointTarget(HOME), MotionSettings(), fly=fly) for fly in (False, True))
    assert list(stop_to_stop([fly, Delay(1.0), stop, stop, fly])) == [[fly, stop], [stop], [fly]]
    assert list(stop_to_stop([stop])) == [[stop]]


@pytest.mark.parametrize(
    ("later", "said"),
    [
        ({"emergency_stop": True}, "emergency stop"),
        ({"drives_on": False}, "drives went off"),
        ({"alarms": ("4711",)}, "4711"),
        ({"cell_closed": False}, "cell was opened"),
        ({"mode": "teach"}, "mode was changed"),
        ({"override": 0.9}, "90 %"),
        ({"override": 1.2}, "120 %"),
    ],
)
def test_what_changes_in_motion_stops_the_arm(bench, later, said):
    """Also where the controller itself would go on."""
    bench.controller.blocks, bench.controller.later = 50, later
    taken = []
    guard = bench.open()
    guard.send(program())
    with pytest.raises(SafetyError, match=said), guard.motion(program()) as samples:
        taken.extend(samples)
    assert bench.controller.stops >= 1
    assert bench.controller.starts == 1
    assert 3 <= len(taken) <= 6, "everything that came before the arm rested is handed out, and it rests soon"
    assert not bench.checked.has("NS16-7", program().checksum)


def test_a_state_that_cannot_be_read_any_more_stops_the_arm(bench):
    bench.controller.blocks, bench.controller.status_fails_later = 50, True
    with pytest.raises(ControllerError, match="cannot be read any more"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_what_the_controller_stopped_is_told_as_it_tells_it(bench):
    bench.controller.end = EndReason.PROTECTIVE_STOP
    with pytest.raises(MotionStopped, match=r"protective stop.*run the command again"):
        bench.run(program())


def test_the_controllers_own_word_comes_before_what_the_state_says(bench):
    bench.controller.blocks, bench.controller.end = 50, EndReason.EMERGENCY_STOP
    bench.controller.later = {"emergency_stop": True}
    with pytest.raises(MotionStopped, match=r"emergency stop.*as told"):
        bench.run(program())
    assert bench.controller.stops >= 1


def test_a_look_costs_a_request_and_is_taken_five_times_a_second_of_motion(bench):
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 250_000
    guard = bench.open(clock=lambda: 0.0)
    before = bench.controller.asked.count("AskStatus") + 2  # the two before the start
    bench.run(program(), guard)
    assert 4 <= bench.controller.asked.count("AskStatus") - before <= 6


def test_a_controller_whose_time_stands_still_is_looked_at_all_the_same(bench):
    bench.controller.blocks, bench.controller.pushes, bench.controller.spacing = 40, True, 1
    ticks = iter(range(10**6))
    guard = bench.open(clock=lambda: 0.1 * next(ticks))
    before = bench.controller.asked.count("AskStatus") + 2
    bench.run(program(), guard)
    assert bench.controller.asked.count("AskStatus") - before >= 10


def test_a_link_that_drops_is_told_with_what_to_do(bench):
    bench.controller.vanish_after = 4
    with pytest.raises(DriverError, match=r"make sure that the arm rests.*run the command again") as dropped:
        bench.run(program())
    assert dropped.value.exit_code == 4
    assert bench.controller.starts == 1


def test_a_start_whose_answer_is_lost_is_not_repeated(bench):
    bench.controller.lose_answer = True
    with pytest.raises(DriverError, match="make sure that the arm rests"):
        bench.run(program())
    assert bench.controller.starts == 1


def test_a_refused_start_is_not_repeated_and_not_stopped(bench):
    bench.controller.refuses = Refusal.ALARM
    with pytest.raises(RefusedError, match="alarm"):
        bench.run(program())
    assert (bench.controller.starts, bench.controller.stops) == (1, 0)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, AgentError, SystemExit])
def test_whatever_goes_wrong_with_the_samples_stops_the_arm(bench, error):
    guard = bench.open()
    guard.send(program())
    with pytest.raises(error):
        _take_one_and_raise(guard, error)
    assert (bench.controller.starts, bench.controller.stops) == (1, 1)


def test_a_stop_that_is_not_confirmed_closes_the_link_and_says_so(bench):
    bench.controller.confirms_stop = False
    guard = bench.open()
    guard.send(program())
    with pytest.raises(KeyboardInterrupt):
        _take_one_and_raise(guard, KeyboardInterrupt)
    assert len(bench.warned) == 1
    assert "not confirmed" in bench.warned[0]
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def test_a_closed_link_is_closed(bench):
    guard = bench.open()
    guard.close()
    with pytest.raises(DriverError, match="connect first"):
        guard.position()


def _take_one_and_raise(guard: GuardedLink, error: type[BaseException]) -> None:
    with guard.motion(program()) as samples:
        next(samples)
        raise error("disk full, Ctrl-C, anything")


def test_where_the_arm_stands(bench):
    np.testing.assert_array_equal(bench.open().position(), HOME)
