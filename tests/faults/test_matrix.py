"""Wire × fault × phase, through the command line: exit code, controlled stop, one motion, a log that can be read."""

import numpy as np
import pytest

from drivers.wire.reasons import EndReason
from fake_controller.faults import FAULTS, PHASES, Fault
from fake_controller.servers import IMPOSSIBLE, WIRES
from fake_controller.ur.cell import IMPOSSIBLE as ON_UR
from tests.faults.conftest import HARMLESS

#: What would be harmless elsewhere, but FTP takes an answer that comes twice for that to the next command.
MISLEADING = {("cnr_comau", "duplicate", "upload")}
#: What a wire makes good by asking again; or does not notice, where a frame has no checksum of its own.
MADE_GOOD = {
    "modbus": {("corrupt", "streaming")},
    "cnr_comau": {("corrupt", phase) for phase in PHASES},
}
#: Tried on a UR, in motion; damaged numbers end in more than one way there.
UR_TRIED = {
    *("silent", "drop", "protective_stop", "off_path", "off_speed", "servo_error", "override", "mute"),
    *("emergency_stop", "drive_fault", "alarm", "restart", "reset_counters", "no_numbers", "frozen", "clock_back"),
    *("teach_mode", "lost_client"),
}
#: What the controller refuses a start for.
STATES = ("emergency_stop", "drive_fault", "alarm", "protective_stop", "teach_mode")
#: Of these the agent has to notice in time, so the arm moves in real time.
SLOW_TO_SHOW = ("silent", "lost_client", "override", "mute", "no_numbers", "frozen", "no_end", "clock_back")
#: Motions that are not the planned ones; nothing but their samples tells of them.
ASTRAY = ("off_path", "off_speed", "servo_error", "other_motion")
#: One of each, in the phase where it is worst; and on the other wires what they meet in their own way.
QUICK = {
    *(
        ("tcp", name, next((phase for phase in ("streaming", "upload", "connect") if phase in phases), ""))
        for name, phases in FAULTS.items()
    ),
    ("tcp", "other_motion", "start"),
    ("modbus", "drop", "start"),
    ("modbus", "corrupt", "streaming"),
    ("cnr_comau", "broker_gone", "streaming"),
    ("cnr_comau", "topic_missing", "connect"),
    ("cnr_comau", "queue_full", "upload"),
    ("cnr_comau", "sequence_error", "upload"),
    *(("ur", name, "streaming") for name in ("silent", "drop", "protective_stop", "off_path")),
}
MATRIX = [
    pytest.param(wire, name, phase, marks=() if (wire, name, phase) in QUICK else pytest.mark.verify)
    for wire in (*WIRES, "ur")
    for name in FAULTS
    for phase in PHASES
    if phase in FAULTS[name] and name not in {**IMPOSSIBLE, "ur": ON_UR}[wire]
    if wire != "ur" or (name in UR_TRIED and phase == "streaming")
]


def expected(wire: str, name: str, phase: str) -> tuple[int, int, bool]:
    """Exit code, motions, and whether there is a log. A stop is the agent's after Ctrl-C: its own exit code stays."""
    if phase == "stop":
        return 130, 1, True
    if (wire, name, phase) in MISLEADING:
        return 4, 0, False
    if name in HARMLESS and not (name == "reorder" and phase in ("connect", "upload")):
        return 0, 1, True
    if (name, phase) in MADE_GOOD.get(wire, ()):
        return 0, 1, True
    if name == "emergency_stop":
        return 5, int(phase == "streaming"), phase == "streaming"
    if name in (*ASTRAY, "no_numbers", "frozen") or (wire, name) == (
        "ur",
        "lost_client",
    ):  # there it is a protective stop
        return 5, 1, True
    if name in STATES:
        return (5, 1, True) if phase == "streaming" else (4, 0, False)
    if name == "override" and wire == "cnr_comau":
        return 5, 1, True  # it cannot be read there: the pace of the motion tells
    if name == "override":
        return (5, 1, True) if phase in ("start", "streaming") else (4, 0, False)
    if phase == "start":
        # On Modbus a client that is not heard does not learn that its start was taken: it asks for answers.
        return 4, int(name not in ("restart", "wrong_program")), name == "lost_client" and wire != "modbus"
    return 4, int(phase == "streaming"), phase == "streaming"


@pytest.mark.parametrize(("wire", "name", "phase"), MATRIX)
def test_fault(bench, assert_at_rest, assert_readable, wire, name, phase):
    code, motions, logged = expected(wire, name, phase)
    real = name in (*SLOW_TO_SHOW, *ASTRAY) or phase == "stop" or wire != "tcp"
    moment = 1.0 if real else 0.4  # of motion: in real time the agent has to have had some of it
    controller = bench.serve(
        [Fault(name, phase, moment if phase == "streaming" else 0.0, 1.1 if name == "slow" else 0.0)],
        wire,
        clock="real" if real else "fast",
        interrupt=moment if phase == "stop" else None,
    )
    ended = bench.record()
    assert ended.code == code, ended.errors
    assert "Traceback" not in ended.errors
    assert_at_rest(controller, motions, *((np.inf,) if name in ASTRAY else ()))
    if motions:
        assert (controller.ends == [EndReason.DONE]) is (code == 0 or name == "no_end")
    assert bench.log.exists() is logged
    if logged:
        assert assert_readable(bench.log) >= (1000 if code == 0 else 1)
    if code in (4, 5):
        assert ended.errors.strip().splitlines()[-1].startswith("agent: ")
        assert any(word in ended.errors for word in ("run the command again", "start again", "check "))


@pytest.mark.parametrize("wire", ["tcp", "cnr_comau"])
def test_reports_a_translator_error_with_its_line(bench, wire):
    """The agent's reader took the text, the controller's translator does not: nothing moves."""
    controller = bench.serve([Fault("untranslatable", "upload", value=3)], wire, clock="fast")
    ended = bench.record()
    assert ended.code == 4
    assert "line 3 column 1" in ended.errors
    assert "this translator does not know it here" in ended.errors
    assert controller.motions_started == 0
    assert not bench.log.exists()
