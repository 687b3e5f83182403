"""Programs in motion on the emulated UR: the streamed samples, the causes of a stop, and the omissions."""

import numpy as np
import pytest

from agent.core import InputError
from agent.robot import Dynamics
from fake_controller.build import build_ur_cell
from fake_controller.faults import Fault
from fake_controller.ur.arm import poses_of
from tests.ur_fake.clients import Dashboard, Primary, Rtde, Wire, clients, errors, program, texts, three, turn, warnings
from tests.ur_fake.conftest import CB3

FIELDS = (
    "timestamp", "actual_q", "actual_qd", "target_q", "target_qd", "target_qdd", "actual_current", "runtime_state",
    "safety_mode", "output_int_register_24", "script_control_line", "target_speed_fraction", "actual_TCP_pose",
    "target_TCP_speed",
)  # fmt: skip
HEARTBEAT = "input_int_register_24"


def pose(ur, *offsets):
    """A pose as URScript has it, at an offset [m] from where the tool stands."""
    there = poses_of(ur.cell.kinematics.forward(ur.cell.reference[None]))[0]
    return f"p{[*(there[:3] + offsets).tolist(), *there[3:].tolist()]}"


def square(ur, cycles=1, radius=0.02, speed=0.3):
    """The body of a program that runs blended cycles, each marked in a register."""
    corners = [pose(ur, *offset) for offset in ((0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, -0.05))]
    return [
        'rtde_set_watchdog("input_int_register_24", 2, "stop")',
        f"movej({ur.cell.reference.tolist()}, a=1.4, v=1.05)",
        "i = 0",
        f"while i < {cycles}:",
        "i = i + 1",
        "write_output_integer_register(24, i)",
        *(f"movel({corner}, a=1.2, v={speed}, r={radius})" for corner in corners),
        f"movel({pose(ur, 0, 0, 0)}, a=1.2, v={speed})",
        "end",
        'textmsg("done")',
    ]


class Beating:
    """Writes the heartbeat with every sample that it reads."""

    def __init__(self, client):
        self._client = client
        self._recipe = client.ask("I", HEARTBEAT.encode())[:1]
        self._count = 0

    def beat(self):
        self._count += 1
        self._client.package("U", self._recipe + self._count.to_bytes(4, "big"))


def run(ur, lines, meanwhile=lambda number: None):
    """Samples of a program by field, and what was said."""
    with clients(Rtde(ur.address, *FIELDS), Primary(ur.address)) as (rtde, primary):
        beating = Beating(rtde)
        primary.send(program(*lines).encode())
        samples = []
        while not samples or samples[-1]["runtime_state"] != 1:
            sample = rtde.sample()
            if samples or sample["runtime_state"] == 2:
                samples.append(sample)
                meanwhile(len(samples))
            if len(samples) % 50 == 0:
                beating.beat()
        said = primary.ended()
    return {name: np.array([sample[name] for sample in samples]) for name in FIELDS}, said


@pytest.mark.parametrize("version", [(5, 12, 6, 0), CB3])
def test_cycles_are_run_marked_and_streamed_without_a_gap(start_ur, version):
    ur = start_ur(version=version)
    log, said = run(ur, square(ur, cycles=2))
    assert texts(said) == ["done"]
    np.testing.assert_allclose(np.diff(log["timestamp"]), ur.cell.period, atol=1e-9)
    assert [*dict.fromkeys(log["output_int_register_24"])][-2:] == [1, 2]
    assert {8, 9, 10, 11} <= set(log["script_control_line"])
    begun = [int(np.argmax(log["output_int_register_24"] == cycle)) for cycle in (1, 2)]
    length = begun[1] - begun[0]
    first, second = (log["target_q"][at : at + length] for at in begun)
    np.testing.assert_allclose(first, second, atol=1e-9)
    middle = (log["target_qd"][1:] + log["target_qd"][:-1]) / 2
    np.testing.assert_allclose(np.diff(log["target_q"], axis=0) / ur.cell.period, middle, atol=0.05)
    speed = np.linalg.norm(log["target_TCP_speed"][:, :3], axis=1)
    assert 0.29 < speed.max() < 0.31
    assert ur.cell.history() == "motions started 1; ended: done; at rest"


def test_currents_are_torques_over_gear_and_constant(start_ur):
    """Coarse, noisy, and what a rigid arm with friction needs."""
    ur = start_ur()
    log, _ = run(ur, square(ur))
    gains = 101 * np.array([0.1005, 0.1005, 0.1003, 0.0802, 0.0812, 0.08])
    torque = log["actual_current"] * gains
    rigid = Dynamics(ur.cell.robot).inverse_dynamics(log["target_q"], log["target_qd"], log["target_qdd"])
    rest = np.sqrt(np.mean((torque - rigid) ** 2, axis=0))
    assert (rest < [20, 25, 20, 6, 6, 6]).all()
    assert (rest > 0.1).all()
    counts = torque / (2 * np.array([150, 150, 150, 28, 28, 28]) / 2**12)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-3)
    np.testing.assert_allclose(log["actual_q"], log["target_q"], atol=0.02)
    assert np.abs(log["actual_q"] - log["target_q"]).max() > 1e-5


def test_a_hidden_effect_is_in_the_currents(start_ur):
    hidden = {"effect": "payload", "parameters": {"mass": 1.5, "centre": [0, 0, 0.05]}}
    healthy, loaded, names = start_ur(), start_ur(effects=[hidden]), ("actual_current", "payload")
    with clients(Rtde(healthy.address, *names), Rtde(loaded.address, *names)) as (first, second):
        difference = second.sample()["actual_current"] - first.sample()["actual_current"]
        assert second.sample()["payload"] == 0
    assert abs(difference[1]) > 0.3


def test_blends_that_overlap_leave_a_move_out(start_ur):
    ur = start_ur()
    log, said = run(ur, square(ur, radius=0.06))
    assert {code for code, _ in warnings(said)} == {258}
    assert "Overlapping Blends in line 9" in warnings(said)[0][1]
    assert 9 not in log["script_control_line"]
    assert texts(said) == ["done"]


def test_a_statement_after_a_blended_move_runs_as_the_blend_begins(start_ur):
    ur = start_ur()
    corner, end = (f"movel({pose(ur, 0.1, y, 0)}, a=1.2, v=0.2" for y in (0, 0.1))
    log, _ = run(ur, [f"{corner}, r=0.04)", "write_output_integer_register(24, 7)", f"{end})"])
    at = int(np.argmax(log["output_int_register_24"] == 7))
    corner = poses_of(ur.cell.kinematics.forward(log["target_q"][:1]))[0, :3] + [0.1, 0, 0]
    there = poses_of(ur.cell.kinematics.forward(log["target_q"][at : at + 1]))[0, :3]
    assert np.linalg.norm(there - corner) == pytest.approx(0.9 * 0.04, abs=1e-3)


def test_a_move_that_is_too_fast_or_out_of_reach_ends_in_a_protective_stop(start_ur):
    for line, text in (
        ("movej([3, -1, -1, 0, 0, 0], v=4, a=20)", "faster than its limit"),
        ("movel(p[3, 0, 0, 0, 0, 0])", "out of reach"),
    ):
        ur = start_ur()
        with clients(Primary(ur.address), Dashboard(ur.address)) as (primary, dashboard):
            primary.send(program(line).encode())
            said = primary.ended()
            assert text in errors(said)[0][2]
            assert dashboard.ask("safetystatus") == "Safetystatus: PROTECTIVE_STOP"


def test_the_slider_stretches_time_and_not_the_path(start_ur):
    ur = start_ur()
    full, _ = run(ur, square(ur))
    with clients(Rtde(ur.address)) as slider:
        recipe = slider.ask("I", b"speed_slider_mask,speed_slider_fraction")[:1]

        def turn(number):
            if number == 100:
                slider.package("U", recipe + bytes.fromhex("00000001 3fe0000000000000"))  # to one half

        slow, _ = run(ur, square(ur), turn)
    assert (full["target_speed_fraction"][-1], slow["target_speed_fraction"][-1]) == (1.0, 0.5)
    assert len(slow["timestamp"]) > 1.3 * len(full["timestamp"])
    apart = np.array([np.abs(full["target_q"] - q).max(axis=1).min() for q in slow["target_q"][::25]])
    assert apart.max() < 2e-3
    assert np.abs(np.diff(slow["target_qd"], axis=0)).max() / ur.cell.period < 60


def test_a_program_whose_heartbeat_ends_comes_to_a_protective_stop(start_ur):
    ur = start_ur()
    with clients(Primary(ur.address)) as primary:
        primary.send(program(*square(ur, cycles=1000)).encode())
        said = primary.ended()
    assert "nothing was heard of input_int_register_24" in warnings(said)[0][1]
    assert texts(said) == []
    assert ur.cell.ends[0].name == "WATCHDOG"


@pytest.mark.parametrize("how", ["dashboard", "primary", "another program", "protective_stop", "emergency_stop"])
def test_a_stop_keeps_to_the_path_and_ends_stationary(start_ur, how):
    faults = [Fault(how, "streaming", 1.0)] if "_stop" in how else []
    ur = start_ur(faults=faults)
    with three(ur, *FIELDS) as (primary, dashboard, rtde):
        primary.send(program(*square(ur, 1000)[1:]).encode())
        rtde.until(lambda sample: np.abs(sample["target_qd"]).max() > 0.2)
        if how == "dashboard":
            assert dashboard.ask("stop") == "Stopped"
        elif how == "primary":
            primary.send(b"stop program\n")
        elif how == "another program":
            primary.send(program("sync()").encode())
        samples = rtde.until(lambda sample: sample["runtime_state"] in (1, 4) and not sample["target_qd"].any())
    q, qd = (np.array([sample[name] for sample in samples]) for name in ("target_q", "target_qd"))
    middle = (qd[1:] + qd[:-1]) / 2
    np.testing.assert_allclose(np.diff(q, axis=0) / ur.cell.period, middle, atol=0.05)
    assert np.abs(np.diff(qd, axis=0)).max() / ur.cell.period < 60
    assert bool(ur.cell.ends) == (how != "protective_stop")  # paused there


def test_a_fault_sets_the_clock_back(start_ur):
    lying = start_ur(faults=[Fault("clock_back", "streaming", 0.5, 30.0)])
    with clients(Primary(lying.address), Rtde(lying.address, "timestamp")) as (primary, rtde):
        primary.send(program(turn(lying, 0.5)).encode())
        before = rtde.sample()["timestamp"]
        rtde.until(lambda sample: sample["timestamp"] < before)


def test_a_client_that_does_not_read_is_dropped(start_ur):
    """A cell in no hurry waits for it, but not for long."""
    ur = start_ur()
    with clients(Rtde(ur.address, *FIELDS), Rtde(ur.address, "timestamp")) as (idle, reader):
        first = reader.sample()["timestamp"]
        reader.until(lambda sample: sample["timestamp"] > first + 1.5)
        with pytest.raises((EOFError, ConnectionError)):
            idle.until(lambda sample: sample["timestamp"] > first + 1.5)


def test_a_slow_client_misses_states_and_delays_nobody(start_ur):
    """Real time does not wait for clients."""
    ur = start_ur(clock="real")
    with clients(Wire(ur.address, 30001), Rtde(ur.address, "timestamp")) as (idle, reader):
        idle.socket.setsockopt(1, 8, 4096)  # SOL_SOCKET, SO_RCVBUF
        times = [reader.sample()["timestamp"] for _ in range(1500)]
    np.testing.assert_allclose(np.diff(times), 0.002, atol=1e-9)


def test_effects_and_faults_that_a_ur_cannot_have_are_refused():
    with pytest.raises(InputError, match="interpolator_mismatch is not simulated on UR controllers"):
        build_ur_cell("ur5e", 0, "fast", [{"effect": "interpolator_mismatch", "parameters": {"rate": 0.9}}])
    with pytest.raises(InputError, match="wrong_program makes no sense on ur"):
        build_ur_cell("ur5e", 0, "fast", faults=[Fault("wrong_program", "start")])
    with pytest.raises(InputError, match="comau_ns16 is no robot of Universal Robots"):
        build_ur_cell("comau_ns16", 0, "fast")
