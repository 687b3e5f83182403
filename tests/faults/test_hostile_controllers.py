"""Controllers on every wire that are another robot, or leave the plan where points were sent instead of a program."""

from pathlib import Path

import pytest

from fake_controller.faults import Fault, Faults
from fake_controller.servers import WIRES
from tests.conftest import DESCRIPTION, URDF

#: Names that are not those of the description, whose joints are shoulder and elbow.
NAMES = [("elbow", "shoulder"), ("shoulder", "Elbow"), ("joint_1", "joint_2")]


def _named(folder: Path, names: tuple[str, str]) -> str:
    """The small arm with other names of its joints."""
    folder.mkdir()
    for file, text in {"arm.urdf": URDF, "robot.yaml": DESCRIPTION}.items():
        for old, new in zip(("shoulder", "elbow"), ("first", "second"), strict=True):
            text = text.replace(old, new)
        for old, new in zip(("first", "second"), names, strict=True):
            text = text.replace(old, new)
        (folder / file).write_text(text, encoding="utf-8")
    return str(folder / "robot.yaml")


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("wire", [WIRES[0], *(pytest.param(wire, marks=pytest.mark.verify) for wire in WIRES[1:])])
def test_wrong_joint_names_prevent_motion(bench, arm: str, tmp_path: Path, wire: str, names: tuple[str, str]):
    bench._arm = _named(tmp_path / "other", names)
    controller = bench.serve(wire=wire)
    bench.recipe.write_text(bench.recipe.read_text(encoding="utf-8").replace(bench._arm, arm), encoding="utf-8")
    ended = bench.record()
    assert ended.code == 4, ended.errors
    assert names[0] in ended.errors
    assert controller.motions_started == 0


AWAY = "PROGRAM p\nBEGIN\n  $TOOL := POS(0, 0, 0, 0, 0, 0, '')\n  MOVE JOINT TO {0, 0, -90, 0, 20, 0}\nEND p\n"
SWING = """PROGRAM swing
VAR k : INTEGER
BEGIN
  FOR k := 1 TO 3 DO
    MOVE JOINT TO {20, 5, -80, 10, 30, 10}
    MOVE JOINT TO {-10, 0, -90, 0, 20, 0}
  ENDFOR
END swing
"""


@pytest.mark.verify
@pytest.mark.parametrize("name", ["off_path", "off_speed", "servo_error", "other_motion"])
def test_via_points_that_are_not_followed_end_in_a_stop(bench, name: str):
    """By the arm of six joints: straight lines cannot begin in the pose in which it wakes up."""
    bench._arm = "comau_ns16"
    controller = bench.serve(wire="cnr_comau", clock="real")  # in fast time the motion may end before its stop
    bench.program.write_text(AWAY, encoding="utf-8")
    bench.log = bench.folder / "away.mcap"
    assert bench.record().code == 0
    controller.faults = Faults([Fault(name, *(("start",) if name == "other_motion" else ("streaming", 0.5)))])
    text = bench.recipe.read_text(encoding="utf-8")
    bench.write_for("cnr_comau", text.split('address: "')[1].split('"')[0] + ",mode=points")
    bench.program.write_text(SWING, encoding="utf-8")
    bench.log = bench.folder / "swing.mcap"
    ended = bench.record()
    assert ended.code == 5, ended.errors
    assert controller.ends[-1].name == "STOPPED"
