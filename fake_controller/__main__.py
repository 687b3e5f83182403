"""`python -m fake_controller`: the emulated controller as a process of its own."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from pathlib import Path

from agent.errors import AgentError


def main(arguments: list[str] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit code."""
    options = _parser().parse_args(arguments)
    done = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: done.set())

    from fake_controller.build import build_controller
    from fake_controller.server_tcp import TcpServer

    try:
        controller = build_controller(options.robot, options.seed, options.clock)
    except AgentError as error:
        print(f"fake controller: {error}", file=sys.stderr)
        return error.exit_code
    try:
        server = TcpServer(controller, options.address, options.port)
    except OSError as error:
        where = f"{options.address}:{options.port}"
        print(f"fake controller: cannot listen at {where}: {error.strerror}; is the port taken?", file=sys.stderr)
        return 2
    try:
        if options.ready_file is not None:
            _write_whole(options.ready_file, server.address + "\n")
        print(f"fake controller: {controller.robot.name} at {server.address}, clock {options.clock}", flush=True)
        done.wait()
    except OSError as error:
        print(f"fake controller: {options.ready_file}: {error.strerror}", file=sys.stderr)
        return 2
    finally:
        server.close()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m fake_controller",
        description="An emulated robot controller: it runs the PDL2 programs it is sent on a simulated arm.",
    )
    parser.add_argument("--robot", default="comau_ns16", help="built-in robot, or path of a robot.yaml")
    parser.add_argument("--port", type=_port, default=9100, help="TCP port; 0 takes a free one and prints it")
    parser.add_argument("--address", default="127.0.0.1", help="where to listen; others cannot connect by default")
    parser.add_argument("--seed", type=int, default=0, help="of the arm's true parameters and its noise")
    parser.add_argument("--clock", choices=("fast", "real"), default="real", help="as fast as it goes, or real time")
    parser.add_argument("--ready-file", type=Path, help="write the address there once the port is open")
    return parser


def _port(text: str) -> int:
    port = int(text)
    if not 0 <= port < 65536:
        raise argparse.ArgumentTypeError(f"{port} is not a port; 0 to 65535 are")
    return port


def _write_whole(path: Path, text: str) -> None:
    beside = path.with_name(path.name + ".part")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


if __name__ == "__main__":
    sys.exit(main())
