"""An emulated UR on an address of its own, and clients that know nothing but the published layout."""

from contextlib import ExitStack, closing

import pytest

from fake_controller.build import build_ur_cell
from fake_controller.ur.server import UrServer
from tests.conftest import free_loopback

CB3 = (3, 15, 8, 106339)


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
