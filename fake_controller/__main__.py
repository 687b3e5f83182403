"""`python -m fake_controller`: the emulated controller as a process of its own."""

from __future__ import annotations

import argparse
import gc
import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from agent.core import AgentError, InputError, print_text, read_json, write_atomically
from drivers.errors import ConfigurationError
from fake_controller.actuation import effects_text
from fake_controller.actuation.machine import weighs_nothing
from fake_controller.build import build_controller, build_ros2_cell, build_ur_cell
from fake_controller.controller import Controller
from fake_controller.interpolation import KINDS
from fake_controller.ros2.cell import EFFORTS, Ros2Cell
from fake_controller.scenario import SetupSection, load_scenario
from fake_controller.servers import WIRES, NoBrokerError, Server, open_server
from fake_controller.ur.arm import MODELS
from fake_controller.ur.cell import UrCell
from fake_controller.ur.server import UrServer

#: Shortest watchdog [s] by clock: an arm that is simulated as fast as possible has no steady pace in wall time.
WATCHDOGS = {"fast": 5.0, "real": 0.05}
DEFAULT_PORT, UR, ROS2 = 9100, "ur", "ros2"
HERE, ROS2_ADDRESS = "127.0.0.1", "ros2://0/joint_trajectory_controller"
#: How long [s] the simulated arm may keep the interpreter from the servers' threads. A link with many short exchanges
#: waits for it in each of them, and a controller answers while it plans.
SWITCH_INTERVAL = 0.0005
#: Levels of priority (`nice`) by which the emulator is ahead of other programs.
AHEAD = 10


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    options = _parser().parse_args(arguments)
    if options.list_effects:
        print_text(effects_text())
        return 0
    sys.setswitchinterval(SWITCH_INTERVAL)
    with suppress(OSError):  # a controller has a computer of its own; not every user may have this
        os.nice(-AHEAD)
    done = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: done.set())
    try:
        controller = _controller(options)
        server = _server(options, controller)
    except AgentError as error:
        print(f"fake controller: {error}", file=sys.stderr)
        return error.exit_code
    ready = None
    try:
        if options.ready_file is not None:
            ready = write_atomically(options.ready_file, server.address + "\n")
        gc.freeze()  # to look through all that is here again takes up to a second, in which nothing is sent
        print(f"fake controller: {controller.robot.name} at {server.address}, clock {options.clock}", flush=True)
        done.wait()
    except AgentError as error:
        print(f"fake controller: --ready-file {error}", file=sys.stderr)
        return 2
    finally:
        server.close()
        if ready is not None:
            ready.unlink(missing_ok=True)  # nobody is to take it for the next one's
    if controller.motions_started:
        print(f"fake controller: {controller.history()}", flush=True)
    return 0


def _controller(options: argparse.Namespace) -> Controller | UrCell | Ros2Cell:
    """What the scenario says, where the command line says nothing else; also sets `options.clock` and `driver`.

    Raises:
        InputError: a scenario or an effect that makes no sense, or an unknown robot.
    """
    scenario = None if options.scenario is None else load_scenario(options.scenario)
    setup = SetupSection(clock="real", seed=0) if scenario is None else scenario.setup
    if options.model and options.robot:
        raise InputError("--model has its own robot: leave out --robot")
    options.clock = options.clock or setup.clock
    options.watchdog = options.watchdog or WATCHDOGS[options.clock]
    robot = options.robot or setup.robot
    options.driver = options.driver or (UR if robot in MODELS and not options.model else "tcp")
    effects = list(setup.effects)
    if options.effects:
        data = read_json(options.effects)
        if not isinstance(data, list) or not all(isinstance(entry, dict) for entry in data):
            raise InputError(f"{options.effects}: a list of effects is expected, each with effect, joints, parameters")
        effects += data
    seed = setup.seed if options.seed is None else options.seed
    faults = [] if scenario is None else scenario.build_faults(options.robot)
    about = (robot, seed, options.clock, effects, faults, options.model)
    controller: Controller | UrCell | Ros2Cell
    if options.driver == ROS2:
        _check_ros2(options)
        controller = build_ros2_cell(
            robot, seed, effects, faults, options.model, rate=options.rate, effort=options.effort
        )
    elif options.driver != UR:
        controller = build_controller(*about, options.interpolator)
    elif options.port is not None:
        raise InputError("a UR controller listens at its published ports: leave out --port, choose an --address")
    else:
        controller = build_ur_cell(*about, shortest_watchdog=options.watchdog)
    controller.state = setup.state.model_copy()
    if options.model is None and weighs_nothing(controller.robot):
        print(
            f"fake controller: the URDF of {controller.robot.name} gives no link a mass: this arm has rods of a usual "
            "weight, so its torques are not those of yours",
            file=sys.stderr,
        )
    if scenario is not None:
        print(f"fake controller: scenario {options.scenario}: {scenario.title}", file=sys.stderr)
    return controller


def _check_ros2(options: argparse.Namespace) -> None:
    """Sets the address that ROS 2 has by default.

    Raises:
        InputError: a port, or a clock that is not the wall's.
    """
    if options.port is not None or options.clock != "real":
        raise InputError("ROS 2 has no ports and one clock: leave out --port and --clock fast")
    if options.address == HERE:
        options.address = ROS2_ADDRESS


def _server(options: argparse.Namespace, controller: Controller | UrCell | Ros2Cell) -> Server:
    """The server of the controller's wire.

    Raises:
        InputError: it cannot be opened.
    """
    port = DEFAULT_PORT if options.port is None else options.port
    try:
        if isinstance(controller, UrCell):
            return UrServer(controller, options.address)
        if isinstance(controller, Ros2Cell):
            from fake_controller.ros2.node import Ros2Server

            return Ros2Server(controller, options.address)
        return open_server(
            options.driver,
            controller,
            address=options.address,
            port=port,
            watchdog=options.watchdog,
            waits=options.clock == "fast",
            broker=options.broker,
            node_period=options.node_period and options.node_period * 1e-3,
        )
    except (ImportError, ConfigurationError) as error:
        advice = "; source ROS 2 (Jazzy or later) first, or run `make ros`" if isinstance(error, ImportError) else ""
        raise InputError(f"{error}{advice}") from None
    except NoBrokerError as error:
        raise InputError(f"{error}; start one (apt-get install mosquitto), or name it by --broker") from None
    except OSError as error:
        ports = " (a published port of UR controllers)" if options.driver == UR else f":{port}"
        raise InputError(f"cannot listen at {options.address}{ports}: {error.strerror}; is the port taken?") from None
    except ValueError as error:
        raise InputError(f"{options.scenario}: {error}; choose another --driver") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="agent emulator",
        description="An emulated robot controller: it runs programs (PDL2, URScript) on a simulated arm.",
    )
    add = parser.add_argument
    add("--robot", help="built-in robot (default: comau_ns16), or path of a robot.yaml")
    add(
        "--driver",
        choices=[*WIRES, UR, ROS2],
        help="which driver's wire to speak (default: ur for its robots, else tcp)",
    )
    add(
        "--port",
        type=_port,
        help=f"TCP port (default: {DEFAULT_PORT}); 0 takes a free one and prints it; ur has its published ports",
    )
    add("--address", default=HERE, help=f"where to listen; others cannot connect by default. For ros2: {ROS2_ADDRESS}")
    add("--rate", type=_between(float, 50.0, 1000.0, "rate [Hz]"), default=500.0, help="cycles a second, of ros2")
    add("--effort", choices=EFFORTS, default=EFFORTS[0], help="what joint_states have as effort, of ros2")
    add("--broker", type=_broker, default="127.0.0.1:1883", help="MQTT broker of cnr_comau's samples")
    add(
        "--node-period",
        type=_between(float, 1.0, 20.0, "period of a node [ms]"),
        help="cnr_comau's samples come from a loop of this period [ms], as from the published C5G Open node: uneven "
        "stamps, snapshots repeated and left out, no velocities; without it every sample comes once",
    )
    add("--seed", type=_seed, help="of the arm's true parameters and its noise (default: 0)")
    add("--clock", choices=("fast", "real"), help="as fast as possible, or real time (default)")
    watchdog = _between(float, 0.05, 5.0, "watchdog here")
    add("--watchdog", type=watchdog, help="shortest [s] that a client is granted, 0.05 to 5")
    add("--scenario", type=Path, help="what is set up and what goes wrong; docs/scenarios.md")
    add("--effects", type=Path, help="JSON file: a list of effects to build into the arm")
    add("--list-effects", action="store_true", help="print the effects and their parameters, and end")
    add("--model", type=Path, help="model file that the arm is to be like, effects included")
    add(
        "--interpolator",
        choices=KINDS,
        default=KINDS[0],
        help="the planner's with ramps and blends a few percent off, or another one with a law drawn from the seed",
    )
    add("--ready-file", type=Path, help="write the address there once the port is open")
    return parser


def _between(number: Callable[[str], float], low: float, high: float, what: str) -> Callable[[str], float]:
    """A type of argparse: a number from `low` to `high`."""

    def parse(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is no {what}; {low:g} to {high:.7g} are")
        return value

    parse.__name__ = what  # for argparse's own message
    return parse


_port = _between(int, 0, 65535, "port")


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no seed; a whole number from 0 on is")
    return int(text)


def _broker(text: str) -> tuple[str, float]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is no broker; host:port is")
    return host.strip("[]"), _port(port)


if __name__ == "__main__":
    sys.exit(main())
