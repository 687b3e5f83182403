"""A simulator's file of a few lines that asks for more than any machine has is refused, and the wait can be ended."""

import os
import signal
import threading
from pathlib import Path

import pytest

from agent.core import Ended, InputError, signals_raised
from agent.simulators import mjcf

ARM = '<mujoco><worldbody><body><joint name="a"/><geom size="1"/></body>{}</worldbody></mujoco>'
BOMBS = {
    "replicate": ARM.format('<replicate count="100000000"><geom size="0.1"/></replicate>'),
    "nested": ARM.format('<replicate count="1000"><replicate count="100000"><site/></replicate></replicate>'),
    "composite": ARM.format(
        '<body><composite type="cable" count="100000000 1 1"><geom size="0.1"/></composite></body>'
    ),
    "texture": '<mujoco><asset><texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>'
    + ARM.format("").removeprefix("<mujoco>"),
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_refuses_a_file_that_needs_too_much_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bomb: str):
    monkeypatch.setattr(mjcf, "_SECONDS", 1)
    path = tmp_path / "arm.xml"
    path.write_text(BOMBS[bomb], encoding="utf-8")
    with pytest.raises(InputError, match="MuJoCo does not accept it"):
        mjcf.compiled(path)


def test_a_signal_ends_a_long_compilation(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(BOMBS["replicate"], encoding="utf-8")
    with signals_raised(), pytest.raises(Ended):
        _ended_while(path)


def _ended_while(path: Path) -> None:
    threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGTERM)).start()
    mjcf.compiled(path)


def test_an_ordinary_arm_compiles(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(""), encoding="utf-8")
    assert mjcf.compiled(path).joint(0).name == "a"


def test_passes_on_messages_of_mujoco(tmp_path: Path):
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format("<nonsense/>"), encoding="utf-8")
    with pytest.raises(InputError, match="nonsense"):
        mjcf.compiled(path)
