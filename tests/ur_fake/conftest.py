"""An emulated UR on an address of its own, and clients that know nothing but the published layout."""

import os
import socket
from contextlib import ExitStack, closing

import pytest

from fake_controller.build import build_ur_cell
from fake_controller.ur.server import UrServer

CB3 = (3, 15, 8, 106339)
_tried = 0


def free_loopback():
    """Published ports are fixed, so every server of a test has a loopback address of its own."""
    global _tried
    while True:
        _tried += 1
        address = f"127.{1 + os.getpid() % 200}.{1 + os.getpid() // 200 % 250}.{1 + _tried % 250}"
        with closing(socket.socket()) as probe:
            if probe.connect_ex((address, 30004)) != 0:
                return address


@pytest.fixture
def start_ur():
    """Starts a robot: `start_ur(robot="ur5e", version=…, clock="fast", faults=…)` gives its open server."""
    with ExitStack() as undo:

        def start(robot="ur5e", seed=3, clock="fast", **options):
            cell = build_ur_cell(robot, seed, clock, **options)
            return undo.enter_context(closing(UrServer(cell, free_loopback())))

        yield start


@pytest.fixture
def ur(start_ur):
    """The address of a UR5e."""
    return start_ur().address
