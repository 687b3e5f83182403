"""Driver × fault × phase, through the command line: exit code, controlled stop, one motion, a log that can be read."""

from __future__ import annotations

import pytest

from drivers.wire.reasons import EndReason
from fake_controller.faults import FAULTS, MACHINE, PHASES, Fault

DRIVERS = ("tcp", "modbus")
#: Drivers whose fake servers pass their frames through `Faults`; of the others, what the machine does.
FAULTY_WIRES = ("tcp",)
#: Faults of the wire that lose nothing.
HARMLESS = ("delay", "reorder", "duplicate", "slow")
#: What the controller refuses a start for.
STATES = ("emergency_stop", "drive_fault", "alarm", "protective_stop", "teach_mode")
#: Of these the agent has to notice in time, so the arm moves in real time.
SLOW_TO_SHOW = ("silent", "lost_client", "override")
#: One of each, in the phase where it is worst.
WORST = {
    **{name: "streaming" for name in FAULTS},
    "refuse": "connect",
    "wrong_robot": "connect",
    "wrong_program": "upload",
    "full_memory": "upload",
}
MATRIX = [
    pytest.param(driver, name, phase, marks=() if driver == "tcp" and WORST[name] == phase else pytest.mark.verify)
    for driver in DRIVERS
    for name in FAULTS
    for phase in PHASES
    if phase in FAULTS[name] and (driver in FAULTY_WIRES or name in MACHINE)
]


def expected(name: str, phase: str) -> tuple[int, int, bool]:
    """Exit code, motions, and whether there is a log. A stop is the agent's after Ctrl-C: its own exit code stays."""
    if phase == "stop":
        return 130, 1, True
    if name in HARMLESS and not (name == "reorder" and phase in ("connect", "upload")):
        return 0, 1, True
    if name == "emergency_stop":
        return 5, int(phase == "streaming"), phase == "streaming"
    if name in STATES:
        return (5, 1, True) if phase == "streaming" else (4, 0, False)
    if name == "override":
        return (5, 1, True) if phase in ("start", "streaming") else (4, 0, False)
    if phase == "start":
        return 4, int(name not in ("restart", "wrong_program")), name == "lost_client"
    return 4, int(phase == "streaming"), phase == "streaming"


@pytest.mark.parametrize(("driver", "name", "phase"), MATRIX)
def test_fault(bench, assert_at_rest, assert_readable, driver, name, phase):
    code, motions, logged = expected(name, phase)
    real = name in SLOW_TO_SHOW or phase == "stop" or driver not in FAULTY_WIRES
    controller = bench.serve(
        [Fault(name, phase, 0.4 if phase == "streaming" else 0.0, 1.1 if name == "slow" else 0.0)],
        driver,
        clock="real" if real else "fast",
        interrupt=0.4 if phase == "stop" else None,
    )
    ended = bench.record()
    assert ended.code == code, ended.errors
    assert "Traceback" not in ended.errors
    assert_at_rest(controller, motions)
    if motions:
        assert (controller.ends == [EndReason.DONE]) is (code == 0)
    assert bench.log.exists() is logged
    if logged:
        assert assert_readable(bench.log) >= (1000 if code == 0 else 1)
    if code in (4, 5):
        assert ended.errors.strip().splitlines()[-1].startswith("agent: ")
        assert any(word in ended.errors for word in ("run the command again", "start again", "check "))
