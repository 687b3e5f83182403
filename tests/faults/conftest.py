"""The agent's command line against a fake controller that misbehaves, on real sockets and in one process."""

import math
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from agent.cli import main
from agent.motion import JointTarget, Move, MoveType, create_dialect, with_frames
from agent.motion.urscript.settings import UrSettings
from agent.recording import read_log
from agent.robot import load_robot
from agent.runs import lock
from fake_controller.build import build_controller
from fake_controller.controller import PERIOD, Controller
from fake_controller.faults import Fault, Faults
from fake_controller.servers import BROKER, Server, open_server
from fake_controller.state import State, home
from tests.conftest import drawn, patience
from tests.link.test_ur_driver import SIMULATED, FakeUr

RECIPE = """
robot: {robot}
controller: {{driver: {driver}, address: "{address}"}}
motion:
  speed: 0.5 m/s
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: 5 mm}}
  via_points:
    count: 3
    box:
      centre: [0.6 m, 0 m, 0 m]
      size: [100 mm, 10 mm, 100 mm]
      orientation: [0 deg, 0 deg, 0 deg]
      cone: 10 deg
record: {{rate: 500 Hz, cycles: 2}}
"""
#: Faults of the wire that lose nothing; and of a controller that obeys no stop, where nobody asks for one.
HARMLESS = ("delay", "reorder", "duplicate", "slow", "disobey")
UR_RECIPE = """
robot: ur5e
controller: {{driver: ur, address: "{address}"}}
motion: {{speed: 100 mm/s, fly: {{distance: 20 mm}}, via_points: {{count: 2, like: swing.script, around: 50 mm}}}}
record: {{rate: 500 Hz, cycles: 2}}
"""
PROGRAM = """PROGRAM swing HOLD, PROG_ARM=1
VAR
  k : INTEGER
BEGIN
  FOR k := 1 TO {turns} DO
    MOVE JOINT TO {far}
    MOVE JOINT TO {{-20, 30}}
  ENDFOR
END swing
"""
#: Where the arm swings to [degrees]; the wire where none is named; what is waited for in a motion [samples].
FAR = drawn("{20, -30}", lambda rng: f"{{{rng.integers(10, 26)}, {rng.integers(-36, -20)}}}")
USUAL_WIRE = drawn("tcp", lambda rng: str(rng.choice(["tcp", "modbus"])))
MOMENT = drawn(0, lambda rng: int(rng.integers(0, 1500)))
#: Minutes of motion.
LONG = PROGRAM.format(turns=200, far=FAR).replace("swing", "long")


def ur_program(turns: int) -> str:
    """There and back, about the pose at which an emulated UR5e wakes up."""
    robot = load_robot("ur5e")
    near, settings = home(robot), with_frames(UrSettings(joint_speed=1.0), None)
    moves = [Move(MoveType.JOINT, JointTarget(near + swing), settings) for swing in (0.3, 0.0)]
    return create_dialect("urscript").write("swing", turns * moves, robot)


@dataclass
class Ended:
    """Result of one run of the command line."""

    code: int
    output: str
    errors: str


class Interrupting(Faults):
    """Sends this process a signal once the arm has moved for a given time."""

    def __init__(self, faults: Sequence[Fault], after: float, number: int = signal.SIGINT):
        super().__init__(faults)
        self._after: float | None = after
        self._number = number

    def strike(self, phase: str, motion_time: float = 0.0) -> list[Fault]:
        if phase == "streaming" and self._after is not None and motion_time >= self._after:
            self._after = None
            os.kill(os.getpid(), self._number)
        return super().strike(phase, motion_time)


class Bench:
    """One fake controller, and an agent that records a short program with it."""

    def __init__(self, arm: str, folder: Path, run: Callable[..., Ended], broker: Callable[[], tuple[str, int]]):
        self.folder = folder
        self.log = folder / "swing.mcap"
        self.recipe = folder / "recipe.yaml"
        self.program = folder / "swing.pdl"
        self._arm = arm
        self._run = run
        self._broker = broker
        self._servers: list[Server] = []
        self._turns = 3

    def serve(
        self,
        faults: Sequence[Fault] = (),
        wire: str = USUAL_WIRE,
        clock: str = "fast",
        interrupt: float | None = None,
        number: int = signal.SIGINT,
        **state: object,
    ) -> Controller:
        """Start a controller; the recipe and the program are written for it."""
        goes_wrong = Faults(faults) if interrupt is None else Interrupting(faults, interrupt, number)
        if wire == "ur":
            if any(fault.name not in HARMLESS for fault in faults):
                self._turns = 3 + math.ceil(patience(2.0))
            fake = FakeUr(clock, goes_wrong)
            self._servers.append(fake)
            self.write_for(wire, fake.address)
            return fake
        controller = build_controller(self._arm, 3, clock)
        controller.faults = goes_wrong
        controller.state = State(**state)
        watchdog = 2.0 if clock == "fast" else 0.5 if wire == "tcp" else 1.0  # where one asks and waits it takes longer
        watchdog, nominal = patience(watchdog), watchdog
        if clock == "real":  # the motion lasts longer than a busy machine's watchdog; a turn takes more than a second
            self._turns = 3 + math.ceil(watchdog - nominal)
        broker = self._broker() if wire == "cnr_comau" else BROKER
        server = open_server(wire, controller, watchdog=watchdog, waits=clock == "fast", broker=broker)
        self._servers.append(server)
        queued = any(fault.name in ("queue_full", "sequence_error") for fault in faults)
        self.write_for(wire, f"{server.address},mode=points" if queued else server.address)
        return controller

    def write_for(self, wire: str, address: str) -> None:
        """The recipe and the program for a controller that is there."""
        if wire == "ur":
            self.program = self.folder / "swing.script"
            self.recipe.write_text(UR_RECIPE.format(address=address), encoding="utf-8")
            self.program.write_text(ur_program(self._turns), encoding="utf-8")
            return
        text = RECIPE.format(robot=self._arm, driver=wire, address=address)
        self.recipe.write_text(text, encoding="utf-8")
        self.program.write_text(PROGRAM.format(turns=self._turns, far=FAR), encoding="utf-8")

    def record(self, *options: str) -> Ended:
        """`agent record`."""
        return self._run("record", self.recipe, "--program", self.program, "-o", self.log, *options)

    def close(self) -> None:
        for server in self._servers:
            server.close()


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Callable]:
    """The command line in this process, off a terminal, in the test's folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(lock, "FOLDERS", (tmp_path,))  # all loopback addresses are one machine, and UR's ports one
    monkeypatch.setattr(SIMULATED, min(patience(2.0), 5.0))
    before = signal.getsignal(signal.SIGTERM)

    def call(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["agent", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        captured = capsys.readouterr()
        return Ended(int(end.value.code or 0), captured.out, captured.err)

    yield call
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def bench(request: pytest.FixtureRequest, arm: str, tmp_path: Path, run: Callable[..., Ended]) -> Iterator[Bench]:
    """A bench whose servers end with the test."""
    with closing(Bench(arm, tmp_path, run, lambda: request.getfixturevalue("broker").address)) as bench:
        yield bench


@pytest.fixture
def assert_at_rest() -> Callable[..., None]:
    """The arm was set in motion so often, rests, and came to rest on its path within its acceleration.

    `acceleration`: factor on it, for an arm that leaves its path.
    """

    def check(controller: Controller | FakeUr, motions: int, acceleration: float = 1.05) -> None:
        until = time.monotonic() + 30.0
        while controller.motions_started < motions and time.monotonic() < until:
            time.sleep(0.001)  # a start that was taken is carried out, whether its client is still there or not
        assert controller.wait(30.0), "the arm still moves"
        assert controller.motions_started == motions
        if controller.motions_started == 0:
            return
        first, velocity = 0, controller.speeds if isinstance(controller, FakeUr) else []
        while not isinstance(controller, FakeUr) and sum(map(len, velocity)) < controller.recorded:
            at, _, samples = controller.fetch(first, 100_000)
            velocity.append(samples.reference_velocity)
            first = at + len(samples)
        speeds = np.concatenate(velocity)
        np.testing.assert_allclose(speeds[-1], 0.0, atol=1e-9)
        had = np.abs(np.diff(speeds, axis=0)).max(axis=0) / PERIOD
        assert np.all(had <= acceleration * controller.robot.max_acceleration)

    return check


@pytest.fixture
def assert_readable() -> Callable[[Path], int]:
    """A log that can be read from its first to its last sample; returns how many."""

    def check(log: Path) -> int:
        found = read_log(log)
        assert np.all(np.isfinite(found.position))
        assert np.all(np.diff(found.t) > 0)
        return len(found.t)

    return check
