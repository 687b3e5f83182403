"""The adapter of the vendor's library, against a stub of its calls that is compiled on the spot."""

import ctypes
import itertools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from agent.core.errors import InputError
from agent.motion import FlyTrajectory, FlyType, MotionError, Pdl2Settings, Termination, create_interpolator
from agent.motion.orl import ARM, CONTROLLER, LIBRARY, OrlInterpolator
from agent.motion.program import CartesianTarget, Delay, JointTarget, Move, MoveType
from agent.motion.regions import pose_of

#: Moves the joints on straight lines at 10 degrees a second, with one active and one scheduled move; a pose is taken
#: for the joints it happens to have the numbers of. `told` is what it was told, for the tests to read.
CORE = r"""
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

static double period, here[10], targets[2][10];
static int waiting, step_number;
char told[1 << 16];

static void say(const char *format, ...) {
    size_t used = strlen(told);
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(told + used, sizeof told - used, format, arguments);
    va_end(arguments);
}

static int queue_move(const double *target) {
    if (waiting == 2) return -3;
    memcpy(targets[waiting++], target, sizeof here);
    return 0;
}

static int next_step(double *joints) {
    if (waiting == 0) return -42;
    double largest = 0.0;
    for (int k = 0; k < 10; ++k) largest = fmax(largest, fabs(targets[0][k] - here[k]));
    int steps = (int)ceil(largest / (10.0 * period));
    ++step_number;
    for (int k = 0; k < 10; ++k)
        joints[k] = here[k] + (targets[0][k] - here[k]) * (steps ? (double)step_number / steps : 1.0);
    if (step_number < steps) return 0;
    memcpy(here, targets[0], sizeof here);
    memcpy(targets[0], targets[1], sizeof here);
    step_number = 0;
    return --waiting ? ASKS : 2;
}
"""

VENDOR = (
    CORE
    + r"""
typedef struct { int unit; double x, y, z, a, e, r; char flags[80]; } pose_t;
typedef struct { int unit; double value[10]; } joints_t;
typedef struct { int type, permission, iv; double dv; char sv[255]; char name[80]; } variable_t;

int ORL_initialize_controller(const char *file, const char *folder, int verbose, int controller) {
    say("start %s %s %d %d\n", file, folder, verbose, controller);
    return strcmp(file, "bad.c5g") ? 0 : -7;
}
int ORL_terminate_controller(int verbose, int controller) { return 0; }
int ORL_initialize_frames(pose_t base, pose_t tool, pose_t uframe, int verbose, int controller, int arm) {
    say("frames %d %g %g %g arm %d\n", base.unit, base.x, tool.z, uframe.r, arm);
    return 0;
}
int ORL_select_point_accuracy(int kind, int verbose, int controller, int arm) { say("accuracy %d\n", kind); return 0; }
int ORL_set_interpolation_time(double milliseconds, int verbose, int controller, int arm) {
    if (milliseconds < 0.4) return -9;
    period = milliseconds / 1000.0;
    return 0;
}
int ORL_get_next_interpolation_step(joints_t *joints, int verbose, int controller, int arm) {
    return joints->unit == 3 ? next_step(joints->value) : -8;
}
int ORL_set_position(pose_t *pose, joints_t *joints, int verbose, int controller, int arm) {
    if (pose || !joints || joints->unit != 3 || waiting) return -4;
    memcpy(here, joints->value, sizeof here);
    return 0;
}
int ORL_set_move_parameters(int fly, int advance, int fly_type, int kind, pose_t *pose, joints_t *joints,
                            int verbose, int controller, int arm) {
    say("move %d %d %d %d", fly, advance, fly_type, kind);
    if (pose) {
        say(" pose %d %g %g %g %g %g %g", pose->unit, pose->x, pose->y, pose->z, pose->a, pose->e, pose->r);
        say(" '%s'\n", pose->flags);
        return kind == 4 ? -6 * (pose->x > 1050.0) : -5;
    }
    say(" joints\n");
    return joints->unit == 3 ? queue_move(joints->value) : -8;
}
int ORL_set_data(variable_t variable, int verbose, int controller) {
    say("set %s %d %d %g\n", variable.name, variable.type, variable.iv, variable.dv);
    return variable.dv > 2.5 ? -11 : 0;
}
int ORL_dominant_interpolation(int kind, int rotation, int verbose, int controller, int arm) {
    say("dominant %d %d\n", kind, rotation);
    return 0;
}
int ORL_orientation_interpolation(int kind, int verbose, int controller, int arm) {
    say("orientation %d\n", kind);
    return 0;
}
int ORL_cancel_motion(int verbose, int controller, int arm) { waiting = step_number = 0; return -1; }
int ORL_set_fly_parameter(int kind, double value, int verbose, int controller, int arm) {
    say("fly %d %g\n", kind, value);
    return 0;
}
"""
)


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler here: the stubs for the vendor's library cannot be built")
    numbers = itertools.count()

    def build(text: str, asks: int = 1) -> Path:
        folder = tmp_path_factory.mktemp("orl")
        source, library = folder / "stub.c", folder / f"stub{next(numbers)}.so"
        source.write_text(text)
        command = [compiler, "-shared", "-fPIC", "-Wall", f"-DASKS={asks}", "-o", library, source, "-lm"]
        subprocess.run([str(part) for part in command], check=True)
        return library

    return build


@pytest.fixture(scope="module")
def vendor(built) -> Path:
    return built(VENDOR)


@pytest.fixture
def controller(tmp_path, monkeypatch) -> Path:
    file = tmp_path / "CELL.c5g"
    file.write_text("")
    monkeypatch.setenv(CONTROLLER, str(file))
    monkeypatch.delenv(ARM, raising=False)
    return file


def heard(library: Path) -> list[str]:
    """Calls of the stub since the last check."""
    text = (ctypes.c_char * (1 << 16)).in_dll(ctypes.CDLL(str(library)), "told")
    lines = text.value.decode().splitlines()
    text.value = b""
    return lines


def joint_move(q, fly=False, **settings):
    return Move(MoveType.JOINT, JointTarget(q), Pdl2Settings(**settings), fly=fly)


def test_a_program_is_stepped_through_the_library(vendor, controller, ns16, home):
    orl = create_interpolator("orl", ns16, None, period=0.002, library=vendor)
    turns = np.radians([[1, 0, 0, 0, 0, 0], [1, 0.5, 0, 0, -0.5, 0], [0, 0.5, 0.3, 0, 0, 0], [0, 0, 0.3, 0, 0, 1]])
    chain = [joint_move(home + turn, fly=k < 3) for k, turn in enumerate(turns)]
    trajectory = orl.plan([*chain, Delay(0.02), joint_move(home)], home)
    assert np.array_equal(trajectory.q[0], home)
    assert np.allclose(trajectory.q[-1], home, atol=1e-12)
    assert np.allclose(np.diff(trajectory.t), 0.002)
    for turn in turns:  # three and more moves go through its two slots
        assert np.min(np.abs(trajectory.q - home - turn).max(axis=1)) < 1e-9
    assert np.allclose(np.abs(trajectory.qd[10:40, 0]), np.radians(10), rtol=1e-6)
    assert list(np.unique(trajectory.move)) == [0, 1, 2, 3, 4, 5]
    assert np.count_nonzero(trajectory.move == 4) == 10


def test_initialises_the_vendor_library_once_with_its_own_names(vendor, controller, ns16, home, monkeypatch):
    monkeypatch.setenv(ARM, "2")
    heard(vendor)
    for _ in range(2):
        orl = OrlInterpolator(ns16, library=vendor)
    assert heard(vendor) == [f"start CELL.c5g {controller.parent}/ 0 0"]
    frame = tuple(tuple(row) for row in pose_of([0.0, 0.0, 0.12, 0.0, 0.0, 0.0]))
    fly = {"fly_type": FlyType.FLY_CART, "fly_trajectory": FlyTrajectory.FLY_TOL, "fly_distance": 0.02}
    overrides = {"arm_override": 0.5, "stress_percent": 40.0, "linear_speed": 0.7, "termination": Termination.NOSETTLE}
    first = joint_move(home + 0.01, fly=True, tool=frame, **fly, **overrides)
    orl.plan([first, joint_move(home, fly=True, fly_percent=60.0), joint_move(home + 0.01)], home)
    lines = heard(vendor)
    assert lines[:12] == [
        "frames 50 0 120 0 arm 1",
        "accuracy 2",
        "orientation 2",
        "dominant 1 1",
        "set $ARM_DATA[2].LIN_SPD 3 0 0.7",
        "set $ARM_DATA[2].ROT_SPD 3 0 1",
        "set $ARM_DATA[2].SPD_OVR 1 100 0",
        "set $ARM_DATA[2].ACC_OVR 1 100 0",
        "set $ARM_DATA[2].DEC_OVR 1 100 0",
        "set $ARM_DATA[2].ARM_OVR 1 50 0",
        "set $ARM_DATA[2].STRESS_PER 1 40 0",
        "fly 8 20",
    ]
    assert [line for line in lines if line.startswith("move")] == [
        "move 1 1 5 1 joints",
        "move 1 1 0 1 joints",
        "move 0 0 0 1 joints",
    ]
    assert "fly 7 60" in lines


def test_a_circle_is_passed_as_end_point_then_via_point(vendor, controller, ns16, home):
    orl = OrlInterpolator(ns16, library=vendor)
    heard(vendor)
    end = CartesianTarget(pose_of([1.0, 0.1, 0.8, 0.1, 3.0, -0.2]), "S W T1:1")
    way = CartesianTarget(pose_of([1.1, 0.0, 0.8, 0.1, 3.0, -0.2]))
    with pytest.raises(MotionError, match=r"statement 1.*ORL_set_move_parameters: status -6") as caught:
        orl.plan([Move(MoveType.CIRCULAR, end, via=way)], home)
    assert caught.value.move == 0
    moves = [line for line in heard(vendor) if line.startswith("move")]
    angles = "{:g} {:g} {:g}".format(*np.degrees([0.1, 3.0, -0.2]))
    assert moves == [
        f"move 0 0 0 4 pose 50 1000 100 800 {angles} 'S W T1:1'",
        f"move 0 0 0 4 pose 50 1100 0 800 {angles} ''",
    ]


def test_a_refusal_names_the_variable_and_clears_the_queue(vendor, controller, ns16, home):
    orl = OrlInterpolator(ns16, library=vendor)
    moves = [joint_move(home + 0.01, fly=True), joint_move(home, linear_speed=3.0)]
    with pytest.raises(MotionError, match=r"statement 2.*\$ARM_DATA\[1\]\.LIN_SPD: status -11"):
        orl.plan(moves, home)
    assert len(orl.plan([joint_move(home + 0.01)], home).q) > 1
    long = CartesianTarget(pose_of([1.0, 0.1, 0.8, 0.1, 3.0, -0.2]), "S " * 40)
    with pytest.raises(MotionError, match="79"):
        orl.plan([Move(MoveType.LINEAR, long)], home)


def test_refuses_a_library_that_stops_before_requesting_the_next_move(built, controller, ns16, home):
    orl = OrlInterpolator(ns16, library=built(VENDOR, asks=2))
    moves = [joint_move(home + 0.01, fly=True), joint_move(home, fly=True), joint_move(home + 0.01)]
    with pytest.raises(MotionError, match="before it asked for the next"):
        orl.plan(moves, home)
    with pytest.raises(MotionError, match=r"statement 2.*0\.573 degrees from the target"):
        orl.plan(moves[:1] + [joint_move(home)], home)


def test_reports_a_missing_or_failing_library(vendor, built, controller, ns16, monkeypatch, tmp_path):
    monkeypatch.delenv(LIBRARY, raising=False)
    with pytest.raises(InputError, match=LIBRARY):
        OrlInterpolator(ns16)
    with pytest.raises(InputError, match="does not load"):
        OrlInterpolator(ns16, library=tmp_path / "absent.so")
    with pytest.raises(InputError, match=r"period of 0\.1 ms.*status -9"):
        OrlInterpolator(ns16, period=0.0001, library=vendor)
    monkeypatch.setenv(LIBRARY, str(vendor))
    assert OrlInterpolator(ns16).plan([], np.zeros(6)).q.shape == (1, 6)
    monkeypatch.setenv(ARM, "5")
    with pytest.raises(InputError, match="1 to 4"):
        OrlInterpolator(ns16, library=vendor)
    monkeypatch.setenv(ARM, "1")
    monkeypatch.setenv(CONTROLLER, str(tmp_path / "absent.c5g"))
    with pytest.raises(InputError, match="is not there"):
        OrlInterpolator(ns16, library=vendor)
    bad = tmp_path / "bad.c5g"
    bad.write_text("")
    monkeypatch.setenv(CONTROLLER, str(bad))
    with pytest.raises(InputError, match=r"bad\.c5g: status -7"):
        OrlInterpolator(ns16, library=vendor)
    monkeypatch.delenv(CONTROLLER)
    with pytest.raises(InputError, match=CONTROLLER):
        OrlInterpolator(ns16, library=vendor)


def test_refuses_a_library_without_the_required_functions(ns16, controller):
    import _ctypes

    with pytest.raises(InputError, match="not an ORL library"):
        OrlInterpolator(ns16, library=_ctypes.__file__)
