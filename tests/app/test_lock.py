"""The lock of a robot: one holder, whatever user, and nothing left behind."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import time
from collections.abc import Callable

import pytest

from agent.core.errors import AgentError, BusyError
from agent.runs.lock import lock_file, robot_lock


@pytest.fixture
def robot():
    """Driver and address of a robot that is nobody else's."""
    name = "test", f"{os.getpid()}-{random.random()}"
    yield name
    lock_file(*name).unlink(missing_ok=True)


def _in_a_fork(act: Callable[[], str], user: int | None = None) -> str:
    """What a process of its own says, as another user where one is given."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            if user is not None:
                os.setuid(user)
            os.write(write, act().encode())
        finally:
            os._exit(0)
    os.close(write)
    with open(read, encoding="utf-8") as said:
        text = said.read()
    os.waitpid(child, 0)
    return text


def _attempt(robot) -> str:
    try:
        with robot_lock(*robot):
            return "held"
    except BusyError:
        return "busy"
    except AgentError as error:
        return str(error)


def test_a_process_may_take_it_again_and_another_may_not(robot):
    with robot_lock(*robot):
        with robot_lock(*robot):
            assert _in_a_fork(lambda: _attempt(robot)) == "busy"
        assert _in_a_fork(lambda: _attempt(robot)) == "busy", "the outer one holds it still"
    assert _in_a_fork(lambda: _attempt(robot)) == "held"


def test_nothing_is_left_behind(robot):
    with robot_lock(*robot):
        assert lock_file(*robot).exists()
    assert not lock_file(*robot).exists()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")
@pytest.mark.parametrize("first", [None, 65534])
def test_it_works_for_a_second_user(robot, first):
    """Also with the file that the first one left, as a kill leaves it, and with a mask that hides all."""

    def leave() -> str:
        os.umask(0o077)
        with robot_lock(*robot):
            os.kill(os.getpid(), signal.SIGKILL)
        return ""

    _in_a_fork(leave, first)
    assert lock_file(*robot).exists()
    second = 65534 if first is None else 65533
    assert _in_a_fork(lambda: _attempt(robot), second) == "held"
    with robot_lock(*robot):
        assert _in_a_fork(lambda: _attempt(robot), second) == "busy"
    assert not lock_file(*robot).exists(), "root may take away what others left"


def test_what_killed_processes_have_left_is_taken_away(robot):
    """But nothing that is held, or young: its owner may be about to lock it."""
    left, young, held = (lock_file("test", f"{robot[1]}-{k}") for k in range(3))
    for path in (left, young, held):
        path.touch()
    for path in (left, held):
        os.utime(path, (0, 0))
    try:
        with held.open() as holder:
            fcntl.flock(holder, fcntl.LOCK_EX)
            with robot_lock(*robot):
                pass
            assert [path.exists() for path in (left, young, held)] == [False, True, True]
        with robot_lock(*robot):
            pass
        assert not held.exists()
    finally:
        young.unlink()


def test_who_takes_leftovers_away_makes_no_robot_look_busy(robot, monkeypatch):
    waits = []
    monkeypatch.setattr(time, "sleep", lambda seconds: waits.append(holder.close()))
    holder = lock_file(*robot).open("w")
    fcntl.flock(holder, fcntl.LOCK_EX)
    with robot_lock(*robot):
        assert len(waits) == 1


def test_a_file_that_is_taken_away_meanwhile_is_not_held(robot, monkeypatch):
    """Between the opening and the lock the last holder takes its file away: a lock on that would be nobody's."""
    lock, taken = fcntl.flock, []

    def late(descriptor: int, how: int) -> None:
        if not taken:
            taken.append(descriptor)
            lock_file(*robot).unlink()
        lock(descriptor, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with robot_lock(*robot):
        assert taken
        assert lock_file(*robot).exists()
        assert _in_a_fork(lambda: _attempt(robot)) == "busy"


def test_a_link_in_its_place_is_not_followed(robot, tmp_path):
    lock_file(*robot).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(AgentError, match="the robot's lock cannot be made"), robot_lock(*robot):
        pass
    assert not (tmp_path / "elsewhere").exists()
