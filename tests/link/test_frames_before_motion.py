"""The controller's frames are read and compared before a program moves that leaves them open."""

from contextlib import closing

import numpy as np
import pytest

from agent.core.errors import ControllerError, InputError
from agent.motion.pdl2 import parse_program
from agent.motion.pdl2.variables import FRAMES, pos_to_pose
from agent.motion.program import left_open
from agent.robot import Tool, load_robot, torque_per_ampere
from agent.safety.preconditions import check_frames
from drivers.registry import create
from drivers.transports.tcp.driver import TcpDriver
from fake_controller.build import build_controller
from fake_controller.servers import WIRES, open_server
from fake_controller.servers.cnr.server import CnrServer

MOUNTED = pos_to_pose(np.array([0, 0, 120, 0, 0, 0]))
SET = """PROGRAM p
BEGIN
  $TOOL := POS(0, 0, 120, 0, 0, 0)
  $BASE := POS(10, 20, 30, 40, 50, 60)
  $UFRAME := POS(0, 0, 0, 0, 0, 0)
  MOVE JOINT TO {0, 0, -90, 0, 5, 0}
END p
"""


def test_reports_both_frames_if_they_differ(broker):
    robot = load_robot("comau_ns16")
    controller = build_controller("comau_ns16", seed=3, clock="fast")
    with (
        closing(CnrServer(controller, watchdog=2.0, broker=broker.address, waits=True)) as server,
        closing(create("cnr_comau", server.address)) as driver,
    ):
        driver.torque_per_ampere = torque_per_ampere(robot)
        driver.connect()
        left = controller.frames[2]
        with pytest.raises(ControllerError) as refused:
            check_frames("loop", {"$TOOL": MOUNTED}, driver, "here")
        assert refused.value.exit_code == 4
        assert f"$TOOL is POS({left[0]:g}, {left[1]:g}" in str(refused.value)
        assert "POS(0, 0, 120, 0, 0, 0, '')" in str(refused.value)
        driver.start("p", driver.upload("p", SET))
        assert sum(map(len, driver.samples())) > 0
        check_frames("loop", {"$TOOL": MOUNTED}, driver, "here")
        expected = pos_to_pose(np.array([10, 20, 30, 40, 50, 60]))
        np.testing.assert_allclose(driver.frames()["$BASE"], expected, atol=1e-6)
        with pytest.raises(ControllerError, match=r"\$TOOL"):
            check_frames("loop", {"$TOOL": np.eye(4)}, driver, "here")


@pytest.mark.parametrize("wire", [wire for wire in WIRES if wire != "cnr_comau"])
def test_every_wire_reports_the_active_frames(wire):
    controller = build_controller("comau_ns16", seed=3, clock="fast")
    with (
        closing(open_server(wire, controller, watchdog=5.0, waits=True)) as server,
        closing(create(wire, server.address, watchdog=5.0)) as driver,
    ):
        driver.connect()
        base, uframe, tool = controller.frames
        for name, fields in (("$BASE", base), ("$TOOL", tool), ("$UFRAME", uframe)):
            np.testing.assert_allclose(driver.frames()[name], pos_to_pose(np.array(fields)), atol=1e-9)
        with pytest.raises(ControllerError, match=r"\$TOOL is POS\(.*the plan is for POS\(0, 0, 120, 0, 0, 0"):
            check_frames("loop", {"$TOOL": MOUNTED}, driver, "here")


def test_an_older_controller_reports_no_frames():
    """It refuses the question, or has no such registers; then it is as with a link that has no frames."""
    from drivers.wire import modbus, tcp

    known = {0x0C: tcp.MESSAGES.pop(0x0C)}
    try:
        controller = build_controller("comau_ns16", seed=3, clock="fast")
        with (
            closing(open_server("tcp", controller, watchdog=5.0)) as server,
            closing(TcpDriver(server.address)) as driver,
        ):
            driver.connect()
            assert driver.frames() == {}
    finally:
        tcp.MESSAGES.update(known)
    assert modbus.FRAMES.address + modbus.FRAMES.registers <= modbus.COMMAND.address


@pytest.mark.parametrize(
    ("read", "error", "said"),
    [
        ({}, InputError, r"does not set \$TOOL.*\$TOOL := POS\(0, 0, 120"),
        ({"$UFRAME": MOUNTED}, InputError, r"does not set \$TOOL.*\$TOOL := POS\(0, 0, 120"),
        ({"$TOOL": MOUNTED * np.nan}, ControllerError, r"\$TOOL is POS\(nan"),
    ],
)
def test_refuses_a_program_whose_frame_is_not_read(read, error, said):
    driver = type("Told", (TcpDriver,), {"frames": lambda self: read})("127.0.0.1:1")
    check_frames("loop", {}, driver, "here")
    with pytest.raises(error, match=said):
        check_frames("loop", {"$TOOL": MOUNTED}, driver, "here")


@pytest.mark.parametrize(
    ("said", "move", "names"),
    [
        ("", "MOVE JOINT TO {0, 0, -90, 0, 5, 0}", []),
        ("", "MOVEFLY JOINT TO {0, 0, -90, 0, 5, 0} ADVANCE", ["$TOOL"]),
        ("", "MOVE LINEAR TO {0, 0, -90, 0, 5, 0}", ["$TOOL"]),
        ("", "MOVE JOINT TO POS(1000, 0, 800, 0, 180, 0)", ["$BASE", "$TOOL", "$UFRAME"]),
        ("$TOOL := POS(0, 0, 0, 0, 0, 0)", "MOVE LINEAR TO POS(1000, 0, 800, 0, 180, 0)", ["$BASE", "$UFRAME"]),
        ("$TOOL := POS(0, 0, 9, 0, 0, 0)", "MOVE LINEAR TO {0, 0, -90, 0, 5, 0}", []),
    ],
)
def test_lists_frames_that_a_program_does_not_set(said, move, names):
    statements = parse_program(f"PROGRAM p\nBEGIN\n  {said}\n  {move}\nEND p\n").run()
    assert [*left_open(statements, Tool(frame=MOUNTED), FRAMES)] == names
