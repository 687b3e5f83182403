"""The lock of a robot: one holder, whatever user, and nothing left behind."""

import contextlib
import fcntl
import os
import random
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from agent.core.errors import AgentError, BusyError
from agent.runs import lock, robot_lock
from drivers.endpoints import endpoints


def lock_files(driver: str, address: str) -> list[Path]:
    """Lock files of a controller, held or left behind."""
    names = [lock._NAME.format(lock._digest(one), "*", "*") for one in endpoints(driver, address)]
    return [path for name in names for path in lock._folder().glob(name)]


@pytest.fixture
def robot():
    """Driver and address of a robot that is nobody else's."""
    name = "test", f"{os.getpid()}-{random.random()}"
    yield name
    for path in lock_files(*name):
        path.unlink()


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


def test_the_lock_is_reentrant_within_a_process_only(robot):
    with robot_lock(*robot):
        with robot_lock(*robot):
            assert _in_a_fork(lambda: _attempt(robot)) == "busy"
        assert _in_a_fork(lambda: _attempt(robot)) == "busy", "the outer one holds it still"
    assert _in_a_fork(lambda: _attempt(robot)) == "held"


def test_releasing_another_robots_lock_keeps_this_one(robot):
    """Whoever closes a file lets go of every lock that its process has on it."""
    other = robot[0], f"{robot[1]}-other"
    with robot_lock(*robot):
        with robot_lock(*other):
            pass
        assert _in_a_fork(lambda: _attempt(robot)) == "busy"


def test_removes_the_lock_file(robot):
    with robot_lock(*robot):
        assert len(lock_files(*robot)) == 1
        assert _in_a_fork(lambda: _attempt(robot)) == "busy"
        assert len(lock_files(*robot)) == 1
    assert lock_files(*robot) == []


def _leave(robot) -> str:
    """What a killed process leaves, with a mask that hides all."""
    os.umask(0o077)
    with robot_lock(*robot):
        os.kill(os.getpid(), signal.SIGKILL)
    return ""


as_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can become another user")


@as_root
@pytest.mark.parametrize("first", [None, 65534])
def test_a_second_user_can_take_the_lock(robot, first):
    """Also with the file that the first one left."""
    _in_a_fork(lambda: _leave(robot), first)
    assert len(lock_files(*robot)) == 1
    second = 65534 if first is None else 65533
    assert _in_a_fork(lambda: _attempt(robot), second) == "held"
    with robot_lock(*robot):
        assert _in_a_fork(lambda: _attempt(robot), second) == "busy"


@as_root
@pytest.mark.parametrize("how", ["flock", "shared", "exclusive flock of a name that is not there yet"])
def test_a_file_locked_by_another_user_blocks_no_run(robot, how: str):
    """Who can read a file can lock it, for ever; that counts for nothing."""
    _in_a_fork(lambda: _leave(robot), 65533)
    (path,) = lock_files(*robot)
    holding, ended = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        os.setuid(65534)
        name = path if how in ("flock", "shared") else path.with_name(path.name.replace(".lock", "x.lock"))
        descriptor = os.open(name, os.O_RDONLY | os.O_CREAT * (name != path), 0o600)
        if how == "shared":
            fcntl.lockf(descriptor, fcntl.LOCK_SH)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        os.write(holding[1], b"x")
        os.read(ended[0], 1)
        os._exit(0)
    try:
        os.read(holding[0], 1)
        for user in (None, 65533, 65532):
            assert _in_a_fork(lambda: _attempt(robot), user) == "held"
    finally:
        os.write(ended[1], b"x")
        os.waitpid(child, 0)
        for descriptor in (*holding, *ended):
            os.close(descriptor)


@pytest.mark.parametrize("made", ["link", "fifo", "folder", "socket"])
def test_foreign_files_in_the_lock_folder_block_no_run(robot, tmp_path, made: str):
    with robot_lock(*robot):
        (path,) = lock_files(*robot)
    other = path.with_name(path.name.replace(".lock", "x.lock"))
    if made == "link":
        other.symlink_to(tmp_path / "elsewhere")
    elif made == "fifo":
        os.mkfifo(other, 0o666)
    elif made == "folder":
        other.mkdir()
    else:
        socket.socket(socket.AF_UNIX).bind(str(other))
    try:
        assert _attempt(robot) == "held"
        assert not (tmp_path / "elsewhere").exists()
    finally:
        other.rmdir() if made == "folder" else other.unlink()


@pytest.mark.parametrize("times", [5, pytest.param(100, marks=pytest.mark.verify)])
def test_at_most_one_of_three_simultaneous_runs_gets_the_lock(robot, times):
    for _ in range(times):
        read, write = os.pipe()
        children = []
        for _ in range(3):
            child = os.fork()
            if child == 0:
                os.close(write)
                os.read(read, 1)  # all of them at once
                with contextlib.suppress(BusyError), robot_lock(*robot):
                    made = os.open(f"/tmp/{robot[1]}.alone", os.O_CREAT | os.O_EXCL)
                    os.close(made)
                    os.unlink(f"/tmp/{robot[1]}.alone")
                    os._exit(0)
                os._exit(75)
            children.append(child)
        os.close(read)
        os.close(write)
        ends = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
        assert set(ends) <= {0, 75}, "a second one was let in meanwhile"


SPELLINGS = ["127.0.0.1", "localhost", "127.1", "LOCALHOST", "0x7f.1", "2130706433", "[::1]", "0.0.0.0", "127.0.0.2"]


@pytest.mark.parametrize("driver", ["tcp", "modbus", "cnr_comau"])
@pytest.mark.parametrize("spelt", SPELLINGS)
def test_spellings_of_one_address_share_a_lock(driver: str, spelt: str):
    port = 40000 + os.getpid() % 20000
    end = ",trajectory={}" if driver == "cnr_comau" else ":{}"
    if driver == "cnr_comau":
        spelt = spelt.strip("[]")
    ends = [end.format(port), end.format(f"0{port}")]
    with robot_lock(driver, f"127.0.0.1{ends[0]}"):
        for one in ends:
            assert _in_a_fork(lambda: _attempt((driver, f"{spelt}{one}"))) == "busy"  # noqa: B023  called at once
        assert _in_a_fork(lambda: _attempt((driver, f"{spelt}{end.format(port + 1)}"))) == "held"
        if driver == "modbus":
            assert _in_a_fork(lambda: _attempt(("tcp", f"{spelt}:{port}"))) == "busy", "by another driver too"


def test_address_options_and_localhost_share_a_lock():
    port = 40000 + os.getpid() % 20000
    with robot_lock("cnr_comau", f"127.0.0.1,trajectory={port}"):
        assert _in_a_fork(lambda: _attempt(("cnr_comau", f"localhost,mode=points,trajectory={port}"))) == "busy"


def test_the_message_names_the_holder_of_the_lock(robot):
    with robot_lock(*robot):
        said = _in_a_fork(lambda: _said(robot))
    assert f"process {os.getpid()} of user {os.geteuid()}" in said


def _said(robot) -> str:
    with pytest.raises(BusyError) as error, robot_lock(*robot):
        pass
    return str(error.value)
