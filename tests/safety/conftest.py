"""A guard in front of a controller that does as told, and trajectories for it."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from agent.motion.interpolator import Trajectory
from agent.robot import load_robot
from agent.safety import CheckedPrograms, GuardedLink, Permission, PlannedProgram
from agent.safety.authorisation import Authorisation, AuthorisationDocument, Limits
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import EndReason, Refusal
from tests.conftest import drawn, patience
from tests.safety.following import HOME, at

#: How the joints share in a swing.
SHARES = drawn(np.ones(6), lambda rng: rng.uniform(0.7, 1.1, 6) * rng.choice([-1.0, 1.0], 6))
#: Points between the ends of a longer one.
BETWEEN = drawn(np.zeros(3), lambda rng: rng.uniform(-0.08, 0.08, 3))
NAMES = tuple(f"joint_{k}" for k in range(1, 7))


@dataclass
class Controller:
    """The peer's reports of itself, and its received requests."""

    robot: str = "comau_ns16"
    serial: str = "NS16-7"
    joints: tuple[str, ...] = NAMES
    period: float = 0.002
    stores: str = ""  # checksum it claims for every program
    refuses: Refusal | None = None
    lose_answer: bool = False
    keep_answer: bool = False  # to a start, which it carries out
    loses_start: bool = False  # which never arrives
    confirms_stop: bool = True
    blocks: int = 10
    end: EndReason = EndReason.DONE
    vanish_after: int = -1
    status: dict = field(default_factory=dict)
    later: dict = field(default_factory=dict)  # state from the third block on
    status_fails_later: bool = False
    status_hangs_later: bool = False  # until a stop is asked for
    pushes: bool = False  # all blocks at once, not one a look
    pushes_later: bool = False  # the same once the later state was told
    spacing: int = 2_500_000  # of the samples [ns]
    celsius: tuple[float, ...] = ()  # of the motors
    moves: Callable[[np.ndarray], np.ndarray] = lambda times: at(_trajectory(), times)  # (K,) [s] to (K, n)
    measures: Callable[[np.ndarray], np.ndarray] | None = None  # the same of what is measured, where it is another
    drops: tuple[int, ...] = ()  # blocks that get lost for good
    repeats: int = 1  # of every block
    clock_jump: tuple[int, int] = (-1, 0)  # from this block on stamps are later by this [ns]
    half_closes_after: int = -1  # blocks; it reads on, and sends nothing more
    let_go: threading.Event = field(default_factory=threading.Event)  # the other end has closed the link
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
            case tcp.AskTemperatures():
                return tcp.TemperaturesReply(self.celsius)
            case tcp.AskFrames():
                return tcp.Refused(Refusal.UNKNOWN_MESSAGE, 0, 0, "a controller of before there were frames")
            case tcp.UploadBegin(name, _, checksum):
                state |= {"program": name, "checksum": self.stores or checksum}
                return tcp.Done()
            case tcp.Fetch():
                return tcp.Refused(Refusal.INTERNAL, 0, 0, "gone")
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
        self.controller.let_go.set()

    def _serve(self, connection: socket.socket) -> None:  # noqa: C901
        told, decoder = self.controller, tcp.FrameDecoder(tcp.MAX_REQUEST_PAYLOAD)
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
        sent, running, latest = 0, False, 0.0
        unanswered: list[int] = []

        def send(message: object, request: int = 0) -> None:
            connection.sendall(tcp.encode(message, request))

        def block() -> None:
            nonlocal sent, running, latest
            latest = time.monotonic()
            first = 100 * sent
            zeros = np.zeros((100, 6))
            stamps = (first + np.arange(100)) * told.spacing  # at first, a block is a quarter of a second
            given = told.moves(1e-9 * stamps)
            measured = given if told.measures is None else told.measures(1e-9 * stamps)
            since, later = told.clock_jump
            if 0 <= since <= sent:
                stamps = stamps + later
            for _ in range(0 if sent in told.drops else told.repeats):
                send(tcp.Samples(first, stamps.astype(np.int64), measured, zeros, zeros, given, zeros))
            sent += 1
            if sent == 3:
                state.update(told.later)
            if sent == told.vanish_after:
                connection.shutdown(socket.SHUT_RDWR)
            elif sent == told.half_closes_after:
                connection.shutdown(socket.SHUT_WR)
            elif sent == told.blocks:
                running = False
                send(tcp.End(told.end, 100 * sent, "as told"))

        while data := connection.recv(65536):
            for frame in decoder.feed(data):
                message = tcp.decode(frame)
                if isinstance(message, tcp.Heartbeat):
                    left_out = running and not told.pushes and sent != told.half_closes_after
                    if left_out and time.monotonic() - latest > 0.3:  # a busy machine's look was left out
                        block()
                    continue
                if isinstance(message, tcp.Start):
                    told.starts += 1
                    if told.loses_start:
                        continue
                    if told.lose_answer:
                        connection.shutdown(socket.SHUT_RDWR)
                        return
                    if told.refuses is not None:
                        send(tcp.Refused(told.refuses, 0, 0, "as told"), frame.request)
                        continue
                    if not told.keep_answer:
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
                    for request in unanswered:
                        send(told.answer(tcp.AskStatus(), state), request)
                    if running:
                        running = False
                        reason = EndReason.STOPPED if told.end is EndReason.DONE else told.end
                        send(tcp.End(reason, 100 * sent, "as told"))
                elif isinstance(message, tcp.AskStatus) and told.status_hangs_later and sent >= 3:
                    unanswered.append(frame.request)
                elif isinstance(message, tcp.AskStatus) and running:
                    if told.status_fails_later and sent >= 3:
                        send(tcp.Refused(Refusal.INTERNAL, 0, 0, "no"), frame.request)
                    else:
                        send(told.answer(message, state), frame.request)
                    for _ in range(told.blocks - sent if told.pushes_later and sent >= 3 else 1):
                        block()  # the guard looks at every block, so each look brings the next
                else:
                    send(told.answer(message, state), frame.request)


class Bench:
    """A guard in front of a peer; `asked` are the questions a person got, `warned` what was told."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.controller = Controller()
        self.driver: type[TcpDriver] = TcpDriver
        self.robot = load_robot("comau_ns16")
        self.checked = CheckedPrograms(folder / "checked_programs.json")
        self.answer = False
        self.asked: list[str] = []
        self.warned: list[str] = []
        self.guard: GuardedLink | None = None
        self.address = ""

    def build(
        self,
        yes: bool = True,
        address: str = "",
        rate: float = 500.0,
        clock: Callable[[], float] = time.monotonic,
        **options: object,
    ) -> GuardedLink:
        peer = Peer(self.controller)
        self.address = peer.address

        def ask(question: str) -> bool:
            self.asked.append(question)
            return self.answer

        self.guard = GuardedLink(
            self.driver(peer.address, timeout=patience(2.0), start_timeout=patience(2.0)),
            self.robot,
            address or peer.address,
            rate,
            Permission(self.checked, yes, **options),
            ask,
            self.warned.append,
            clock=clock,
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
def bench(tmp_path: Path) -> Iterator[Bench]:
    """A guard that warns into a list and asks a person who says no."""
    with closing(Bench(tmp_path)) as bench:
        yield bench


@pytest.fixture(scope="session")
def program() -> Callable[..., PlannedProgram]:
    """`program(speed, **changes)`: a small swing that says this speed of itself; changes are columns of its plan."""
    return _program


@pytest.fixture(scope="session")
def authorisation() -> Callable[..., Authorisation]:
    """`authorisation(program, **changes)`: what a person wrote for it."""
    return _authorisation


@pytest.fixture(scope="session")
def swing(trajectory_through):
    """`swing(seconds, turn, start)`: from rest to rest, all joints of the arm."""

    def build(seconds=8.0, turn=1.0, start=0.0):
        knots = np.tile(HOME, (5, 1))
        knots[:, 0] += start + turn * np.array([0.0, 0.4, 0.3, 0.8, 1.0])
        knots[:, 2] += 0.4 * turn * np.array([0.0, 0.3, 0.8, 0.9, 1.0])
        knots[1:4] += turn * np.outer(BETWEEN, SHARES)
        return trajectory_through(knots, seconds)

    return build


def _trajectory(speed: float = 0.1, start: np.ndarray = HOME, seconds: float = 1.0) -> Trajectory:
    """A small swing of every joint; `speed` is what it says of its tool centre point."""
    t = np.arange(0.0, seconds, 0.002)
    swing = 0.05 * (1 - np.cos(2 * np.pi * t / seconds))[:, None]
    rate = np.gradient(swing, 0.002, axis=0)
    q, qd = start + swing * SHARES, rate * SHARES
    poses = np.repeat(np.eye(4)[None], len(t), axis=0)
    return Trajectory(t, q, qd, np.zeros_like(q), poses, np.full(len(t), speed), np.zeros(len(t), int))


def _program(speed: float = 0.1, **changes: object) -> PlannedProgram:
    return PlannedProgram("swing", "PROGRAM swing", (replace(_trajectory(speed), **changes),))


def _authorisation(
    chosen: PlannedProgram, speed: float = 1.0, duration: float = 60.0, **changes: object
) -> Authorisation:
    word = AuthorisationDocument(
        robot="comau_ns16",
        serial="NS16-7",
        program=chosen.checksum,
        problem="0" * 64,
        limits=Limits.model_construct(speed=speed, duration=duration),
        expires=date(2999, 1, 1),
        written_by="M. Rossi",
    )
    return Authorisation(Path("word.yaml"), word.model_copy(update=changes))
