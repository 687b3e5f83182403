"""Fixtures for all tests."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib.util
import itertools
import json
import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, is_hypothesis_test, settings

from agent.robot import RobotDescription, load_robot
from tests.browser import Browser, browser as start_browser
from tests.warm import WarmProcess, shared_nursery

# The same examples every time, so that a test tells of the change and not of the draw; `make verify` draws fresh ones.
# No deadline, and no complaint about slow examples: how long one takes is the machine's affair.
VERIFIES = "CALIBRATION_FIGURES" in os.environ
settings.register_profile("all", derandomize=not VERIFIES, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("few", parent=settings.get_profile("all"))
settings.load_profile("all" if VERIFIES else "few")
#: `make test` tries this part of the examples that a test asks for, but not fewer than these; `make verify` tries all
#: (tests/test_properties.py).
PART, FEWEST = 4, 8

# No garbage is looked for while everything is imported and collected, nor in that later: it stays.
gc.disable()

# Hundreds of processes are started here: what they compile is kept, wherever the environment forbids it or not.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

Draw = TypeVar("Draw")
#: 0 as a rule. `make verify` tries every attack in others as well (tests/security/test_attacks.py).
DRAW = int(os.environ.get("CALIBRATION_DRAW", "0"))


def drawn(usual: Draw, draw: Callable[[np.random.Generator], Draw]) -> Draw:
    """The usual value of a test; another draw gives another of its kind: a posture, a motion, a time, a wire."""
    return usual if DRAW == 0 else draw(np.random.default_rng(DRAW))


ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT / "../shared/data"


def pytest_configure(config: pytest.Config) -> None:
    """All processes of a run start programs from one that has imported them."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        if not list((ROOT / "tests" / "__pycache__").glob("test_house.*-pytest-*.pyc")):
            # In a fresh clone every worker would compile all tests and all inner loops for itself.
            subprocess.run([sys.executable, "-m", "pytest", "--collect-only"], cwd=ROOT, stdout=subprocess.DEVNULL)
        shared = contextlib.ExitStack()
        shared.enter_context(shared_nursery())
        config.add_cleanup(shared.close)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest come first: all commands of the documentation, and whole blind checks. What comes last is short."""
    items.sort(key=lambda item: not re.search("test_documentation|blind_check/test_process", item.nodeid))
    if settings.get_current_profile_name() == "few":
        properties = {item.obj for item in items if isinstance(item, pytest.Function) and is_hypothesis_test(item.obj)}
        for test in properties:
            asked = test._hypothesis_internal_use_settings  # no public name leads to the settings of a test
            few = max(asked.max_examples // PART, min(asked.max_examples, FEWEST))
            test._hypothesis_internal_use_settings = settings(asked, max_examples=few)


def pytest_collection_finish() -> None:
    """The search for garbage among what was collected would take a tenth of the time of some tests."""
    gc.freeze()
    gc.enable()


def loaded(path: Path) -> ModuleType:
    """The module in a file that belongs to no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def environment() -> dict[str, str]:
    """Of a process that runs these sources."""
    return {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of measured data next to the checkout; skips if it is absent."""
    if not SHARED.is_dir():
        pytest.skip("measured data is not here: ../shared/data beside the checkout is missing")
    return SHARED


@pytest.fixture(scope="session")
def ns16() -> RobotDescription:
    """The built-in robot."""
    return load_robot("comau_ns16")


@pytest.fixture(scope="session")
def trajectory_through() -> Callable[..., object]:
    """A function (knots (K, n), duration [s]) → Trajectory at 2 ms through the knots, from rest to rest."""

    from scipy.interpolate import CubicSpline

    from agent.motion import Trajectory

    def build(knots: Sequence[Sequence[float]] | np.ndarray, duration: float = 5.0) -> Trajectory:
        knots = np.asarray(knots, dtype=float)
        t = np.arange(0.0, duration + 1e-9, 0.002)
        spline = CubicSpline(np.linspace(0, t[-1], len(knots)), knots, bc_type="clamped")
        q, qd, qdd = spline(t), spline(t, 1), spline(t, 2)
        unknown = np.full(len(t), np.nan)
        return Trajectory(t, q, qd, qdd, np.full((len(t), 4, 4), np.nan), unknown, np.zeros(len(t), dtype=int))

    return build


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Callable[..., None]:
    """Note a figure for docs/measured/measured.md: `measured("what", value, "unit", "at most 2 %", ok)`.

    It only writes where `make verify` asked for it; the assertion stays in the test.
    """

    def note(what: str, value: float | str, unit: str = "", target: str = "", ok: bool = True) -> None:
        path = os.environ.get("CALIBRATION_FIGURES")
        if path:
            entry = {"what": what, "value": value, "unit": unit, "target": target, "ok": bool(ok)}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"test": request.node.nodeid, **entry}) + "\n")

    return note


@pytest.fixture(scope="session")
def arm(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The robot.yaml of a small arm with two joints."""
    folder = tmp_path_factory.mktemp("arm")
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    (folder / "robot.yaml").write_text(DESCRIPTION, encoding="utf-8")
    return str(folder / "robot.yaml")


_SYSTEM = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1


# A job in the background, or under nohup, ignores these, and so would every program that is tested from there. What is
# caught here is not ignored there, and a terminal that closes still does not end the tests.
for _number, _usual in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
    (signal.SIGHUP, lambda *_: None),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _usual)


def end_with_tests() -> None:
    """`preexec_fn` of what would run for ever: it ends when its tests are killed, where the system can do that."""
    if hasattr(_SYSTEM, "prctl"):
        _SYSTEM.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


class Emulator:
    """The fake controller as a process, as users meet it; as fast as it goes, where nothing else is said."""

    def __init__(self, *options: str) -> None:
        usual = ["--robot", "comau_ns16", "--seed", "7"]
        usual += ["--clock", "fast", "--watchdog", "5"]  # the machine that runs the tests may stall
        usual += [] if "--address" in options else ["--port", "0"]  # a UR has its published ports
        said, says = os.pipe()
        self.process = WarmProcess("fake_controller", *usual, *options, stdout=says, stderr=2)
        os.close(says)
        self._said = os.fdopen(said, encoding="utf-8")
        self.greeting = self._said.readline()
        self.address = self.greeting.split(" at ")[1].split(", clock")[0]

    def end(self) -> None:
        """As a power cut does."""
        self.process.kill()
        self.process.wait()
        self._said.close()


@contextlib.contextmanager
def emulators() -> Iterator[Callable[..., Emulator]]:
    """A function that starts one with more options; all end with the context."""
    running: list[Emulator] = []

    def start(*options: str) -> Emulator:
        running.append(Emulator(*options))
        return running[-1]

    try:
        yield start
    finally:
        for one in running:
            one.end()


@pytest.fixture
def start_controller() -> Iterator[Callable[..., Emulator]]:
    """Starts fake controllers with more options; all end with the test."""
    with emulators() as start:
        yield start


@pytest.fixture(scope="session")
def start_lasting_controller() -> Iterator[Callable[..., Emulator]]:
    """The same for the whole session."""
    with emulators() as start:
        yield start


def patience(seconds: float) -> float:
    """A limit that an idle machine keeps [s], as long as this one needs with what it has to do at the moment."""
    return seconds * min(max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)), 10.0)


_tried = itertools.count(1)


def free_loopback() -> str:
    """Published ports are fixed, so every server of a test has its own loopback address."""
    while True:
        address = f"127.{1 + os.getpid() % 200}.{1 + os.getpid() // 200 % 250}.{1 + next(_tried) % 250}"
        with contextlib.closing(socket.socket()) as probe:
            if probe.connect_ex((address, 30004)) != 0:
                return address


def free_port() -> int:
    """A port of loopback for a program that is started later: none that the system gives to others meanwhile."""
    for port in random.sample(range(20000, 30000), 100):
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    raise OSError("no free port between 20000 and 30000")


def mosquitto() -> str | None:
    """The MQTT broker's program, if there is one."""
    return shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")


class Broker:
    """mosquitto on loopback until it is closed or killed; `address` is its host and port."""

    def __init__(self) -> None:
        program = mosquitto()
        if program is None:
            pytest.skip("needs an MQTT broker: apt-get install mosquitto")
        self.address = ("127.0.0.1", free_port())
        self._folder = tempfile.TemporaryDirectory()
        configuration = Path(self._folder.name) / "mosquitto.conf"
        configuration.write_text(BROKER_CONFIGURATION.format(port=self.address[1]), encoding="utf-8")
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen([program, "-c", configuration], preexec_fn=end_with_tests, **quiet)
        self._wait()

    def kill(self) -> None:
        """End it as a power cut does."""
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        """End it."""
        self.kill()
        self._folder.cleanup()

    def _wait(self) -> None:
        until = time.monotonic() + 10.0
        while time.monotonic() < until and self._process.poll() is None:
            with contextlib.suppress(OSError), socket.create_connection(self.address, 1.0):
                return
        self.close()
        pytest.fail(f"mosquitto did not come up at {self.address}")


@pytest.fixture(scope="session")
def broker() -> Iterator[Broker]:
    """An MQTT broker for everybody who leaves it running."""
    with contextlib.closing(Broker()) as running:
        yield running


@pytest.fixture
def own_broker() -> Iterator[Broker]:
    """One that a test may end."""
    with contextlib.closing(Broker()) as running:
        yield running


def _link(name: str, mass: float) -> str:
    return (
        f'<link name="{name}"><inertial><origin xyz="0.2 0 0"/><mass value="{mass}"/>'
        '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>'
    )


def _joint(name: str, parent: str, child: str, x: float) -> str:
    return (
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} 0 0"/><axis xyz="0 1 0"/>'
        '<limit lower="-3" upper="3" effort="500" velocity="3"/></joint>'
    )


URDF = (
    '<robot name="small_arm"><link name="base"/>'
    + _link("upper", 5.0)
    + _link("lower", 3.0)
    + '<link name="tip"/>'
    + _joint("shoulder", "base", "upper", 0.0)
    + _joint("elbow", "upper", "lower", 0.4)
    + '<joint name="end" type="fixed"><parent link="lower"/><child link="tip"/><origin xyz="0.4 0 0"/></joint></robot>'
)

#: Nothing that is queued is ever thrown away. Who changes its user would not end with its tests.
BROKER_CONFIGURATION = """\
user root
listener {port} 127.0.0.1
allow_anonymous true
persistence false
max_queued_messages 0
max_queued_bytes 0
max_inflight_messages 0
set_tcp_nodelay true
log_type none
"""

DESCRIPTION = """\
name: small_arm
urdf: arm.urdf
tip_frame: tip
cartesian_limits: {linear_speed: 1.5, linear_acceleration: 3, rotational_speed: 2, rotational_acceleration: 6}
joints:
  - {name: shoulder, gear_ratio: 100, nominal_motor_torque: 1, torque_constant: 0.5, max_velocity: 2,
     max_acceleration: 6}
  - {name: elbow, gear_ratio: -80, nominal_motor_torque: 1, torque_constant: 0.4, max_velocity: 3,
     max_acceleration: 9}
"""


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """One Chromium for all tests of pages."""
    with start_browser() as started:
        yield started
