"""The adapter of the vendor's library, against a stand-in compiled on the spot from the header we publish."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import MotionError, create_interpolator
from agent.motion.orl import LIBRARY, OrlInterpolator
from agent.motion.program import CartesianTarget, Delay, JointTarget, MotionSettings, Move, MoveType
from agent.motion.regions import pose_of

HEADER = Path(__file__).parents[2] / "docs"

#: Moves the joints on straight lines at 10 degrees a second; keeps the last move announced for the tests to look at.
STUB = r"""
#include <math.h>
#include <string.h>
#include "orl_shim.h"

static double period = 0.0, here[10];
static orl_move queue[16];
static int waiting = 0, next = 0, step = 0;
orl_move last;

int ORL_set_interpolation_time(double milliseconds) {
    if (milliseconds < 0.4) return 3;
    period = milliseconds / 1000.0;
    waiting = next = step = 0;
    return 0;
}

int ORL_set_move_parameters(const orl_move *move) {
    if (move->size != (int)sizeof(orl_move)) return 11;
    if (waiting == 16) return 12;
    last = *move;
    if (!move->target_is_joints) return 5;
    if (move->first) memcpy(here, move->start, sizeof here);
    queue[waiting++] = *move;
    return 0;
}

int ORL_get_next_interpolation_step(double joints[10]) {
    if (next == waiting) return ORL_IDLE;
    const orl_move *move = &queue[next];
    double largest = 0.0;
    for (int k = 0; k < move->joints; ++k) largest = fmax(largest, fabs(move->target[k] - here[k]));
    int steps = (int)ceil(largest / (10.0 * period));
    ++step;
    for (int k = 0; k < move->joints; ++k)
        joints[k] = here[k] + (move->target[k] - here[k]) * (steps ? (double)step / steps : 1.0);
    if (step < steps) return ORL_MOVING;
    memcpy(here, move->target, sizeof here);
    step = 0;
    if (++next < waiting) return ORL_MOVING;
    next = waiting = 0;
    return ORL_FINAL;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> Path:
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler here: the stand-in for the vendor's library cannot be built")
    folder = tmp_path_factory.mktemp("orl")
    source, built = folder / "stub.c", folder / "stub.so"
    source.write_text(STUB)
    command = [compiler, "-shared", "-fPIC", "-Wall", "-Werror", f"-I{HEADER}", "-o", str(built), str(source), "-lm"]
    subprocess.run(command, check=True)
    return built


def joint_move(q, fly=False):
    return Move(MoveType.JOINT, JointTarget(q), MotionSettings(), fly=fly)


def test_a_program_is_stepped_through_the_library(library, ns16, home):
    orl = create_interpolator("orl", ns16, None, period=0.002, library=library)
    first, second = home + np.radians([1, 0, 0, 0, 0, 0]), home + np.radians([1, 0.5, 0, 0, -0.5, 0])
    trajectory = orl.plan([joint_move(first, fly=True), joint_move(second), Delay(0.02), joint_move(home)], home)
    assert np.array_equal(trajectory.q[0], home)
    assert np.allclose(trajectory.q[-1], home, atol=1e-12)
    assert np.allclose(np.diff(trajectory.t), 0.002)
    assert np.min(np.abs(trajectory.q - first).max(axis=1)) < 1e-9
    cruise = np.abs(trajectory.qd[10:40, 0])
    assert np.allclose(cruise, np.radians(10), rtol=1e-6)
    assert list(np.unique(trajectory.move)) == [0, 1, 2, 3]
    assert np.count_nonzero(trajectory.move == 2) == 10
    assert np.all(trajectory.qd[[0, -1]] == pytest.approx(0, abs=0.1))


def test_what_the_library_is_told(library, ns16, home):
    import ctypes

    from agent.motion.orl import _OrlMove

    orl = OrlInterpolator(ns16, library=library)
    frame = tuple(tuple(row) for row in pose_of([0.0, 0.0, 0.12, 0.0, 0.0, 0.0]))
    settings = MotionSettings(fly_distance=0.02, linear_speed=0.7, stress_percent=40.0, arm_override=0.5, tool=frame)
    target = CartesianTarget(pose_of([1.0, 0.1, 0.8, 0.1, 3.0, -0.2]), "S W T1:1")
    with pytest.raises(MotionError, match=r"statement 1.*status 5") as caught:
        orl.plan([Move(MoveType.LINEAR, target, settings, fly=True)], home)
    assert caught.value.move == 0
    told = _OrlMove.in_dll(ctypes.CDLL(str(library)), "last")
    assert np.allclose(told.target[:6], [1000, 100, 800, *np.degrees([0.1, 3.0, -0.2])])
    assert np.allclose(told.start[:6], np.degrees(home))
    assert (told.fly, told.movement, told.joints, told.first) == (1, 0, 6, 1)
    assert (told.fly_distance, told.linear_speed, told.stress_percent, told.arm_override) == (20.0, 0.7, 40.0, 50.0)
    assert np.allclose(told.tool[:3], [0, 0, 120])
    assert told.configuration == b"S W T1:1"


def test_a_library_that_is_not_there_or_refuses_says_so(library, ns16, monkeypatch, tmp_path):
    monkeypatch.delenv(LIBRARY, raising=False)
    with pytest.raises(InputError, match=LIBRARY):
        OrlInterpolator(ns16)
    with pytest.raises(InputError, match="does not load"):
        OrlInterpolator(ns16, library=tmp_path / "absent.so")
    with pytest.raises(InputError, match="status 3"):
        OrlInterpolator(ns16, period=0.0001, library=library)
    monkeypatch.setenv(LIBRARY, str(library))
    assert OrlInterpolator(ns16).plan([], np.zeros(6)).q.shape == (1, 6)


def test_a_library_without_the_calls_is_refused(ns16):
    with pytest.raises(InputError, match="not an ORL library"):
        OrlInterpolator(ns16, library=_any_library())


def _any_library() -> str:
    import _ctypes

    return _ctypes.__file__
