"""The fake's link of socket programs in bytes from the layouts: records, FTP folder, programs, MQTT topics."""

import ftplib
import io
import json
import struct

import numpy as np
import pytest

from drivers.wire.reasons import EndReason
from fake_controller.faults import Fault
from tests.link.cnr_peer import CLOCK_OFFSET, KEYS, LONG, SHORT, Records, Samples, Socket, program, start, trajectory


def fetched(ftp, name):
    data = io.BytesIO()
    ftp.retrbinary(f"RETR {name}", data.write)
    return data.getvalue()


def test_a_ping_has_the_golden_bytes(bench):
    link = bench.trajectory()
    link.socket.sendall(bytes.fromhex("4c000000 01000000 02000000 00000000") + bytes(64))
    assert link.read() == bytes.fromhex("4c000000 01000000 03000000 01000000 01000000 01000000 00000000") + bytes(52)


def test_the_status_has_the_golden_bytes(bench):
    link = bench.connected(Socket(bench.status_port))
    expected = bytes.fromhex(
        "28000000 0d000000 02000000 0000000001000000 00000000 00000000 00000000 00000000 02000000 01000000"
    )
    assert link.read() == expected


def test_sends_a_record_after_the_last_is_answered(bench):
    link = bench.connected(Socket(bench.feedback_port))
    first = link.read()
    assert first[:20] == bytes.fromhex("cc000000 bc0b0000 02000000 00000000 01000000")
    link.socket.settimeout(0.1)
    with pytest.raises(TimeoutError):
        link.read()
    link.socket.settimeout(20)
    link.socket.sendall(first[:8] + bytes.fromhex("03000000 01000000") + first[16:])
    assert struct.unpack_from("<i", link.read(), 200) > struct.unpack_from("<i", first, 200)


@pytest.mark.parametrize(
    ("changes", "fields"),
    [
        ({"drives_on": False}, (0, 0, 0, 0, 0, 2, 0)),
        ({"emergency_stop": True, "drives_on": False}, (0, 1, 0, 0, 0, 2, 0)),
        ({"alarms": ("62513 motor 3 too hot",)}, (1, 0, 62513, 1, 0, 2, 0)),
        ({"alarms": ("drive fault on axis 2",)}, (1, 0, 1, 1, 0, 2, 0)),
        ({"mode": "teach"}, (1, 0, 0, 0, 0, 1, 0)),
        ({"cell_closed": False}, (1, 0, 0, 0, 0, 2, 0)),
    ],
)
def test_a_state_that_forbids_motion_shows_and_does(bench, changes, fields):
    for name, value in changes.items():
        setattr(bench.controller.state, name, value)
    bench.store(SHORT)
    assert not bench.trajectory().done(start(1))
    status = bench.connected(Records(bench.status_port, "<4i 7i"))
    status.until(lambda record: record[4:] == fields)
    assert bench.controller.motions_started == 0


def test_the_folder_identifies_the_controller(bench):
    identity = json.loads(fetched(bench.ftp(), "agent_identity.json"))
    assert (identity["robot"], identity["serial"], identity["period"]) == ("small_arm", "FAKE-0003", 0.002)
    assert (identity["joint_names"], identity["emulator"]) == (["shoulder", "elbow"], True)


def test_a_stored_program_runs_to_its_end_and_every_sample_is_published(bench, broker):
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(4711))
    end = feedback.until_rest()
    assert end[feedback.LAST_POINT] == 4711
    np.testing.assert_allclose(end[23:25], [20, -30], atol=0.2)
    assert bench.controller.ends == [EndReason.DONE]

    until = 1000 * end[feedback.TIME] + CLOCK_OFFSET
    times, targets = samples.until("target_joints_positions", until)
    np.testing.assert_allclose(np.diff(times), 2000, atol=1)
    recorded = bench.recorded()
    begin = int(np.argmax((targets != targets[0]).any(axis=1)))
    moving = slice(begin, begin + len(recorded))
    stamps = times[moving]
    for topic, values, late in (
        ("target_joints_positions", np.degrees(recorded.reference_position), 0),
        ("target_joints_velocities", np.degrees(recorded.reference_velocity), 0),
        ("real_joints_positions", np.degrees(recorded.position), 0),
        ("real_joints_velocities", np.degrees(recorded.velocity), 0),
        ("motor_currents", recorded.torque / [50, -32], 200),  # gear ratio times torque constant
    ):
        times, published = samples.until(topic, until)
        np.testing.assert_array_equal(times[np.isin(times, stamps + late)], stamps + late)
        np.testing.assert_allclose(published[np.isin(times, stamps + late)], values, rtol=1e-12)
    payload = samples.messages["motor_currents"][0]
    assert payload.endswith(b"}\0")
    assert list(json.loads(payload[:-1])) == KEYS


def test_both_clocks_show_the_same_motion(bench, broker):
    samples = bench.connected(Samples(broker))
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(1))
    end = feedback.until_rest()
    times, positions = samples.until("real_joints_positions", 1000 * end[feedback.TIME] + CLOCK_OFFSET)
    told = [
        record for record in feedback.all if record[feedback.MOVING] and record[feedback.TIME] <= end[feedback.TIME]
    ]
    assert len(told) > 10
    for record in told:
        k = np.argmin(np.abs(times - CLOCK_OFFSET - 1000 * record[feedback.TIME]))
        np.testing.assert_allclose(record[23:25], positions[k], atol=1e-5)


def test_the_same_start_acts_once(bench):
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(SHORT)
    assert link.done(start(7))
    feedback.until_rest()
    assert not link.done(start(7))
    assert bench.controller.motions_started == 1


def test_starts_only_a_selected_program(bench):
    link = bench.trajectory()
    bench.ftp().storbinary("STOR p.pdl", io.BytesIO(SHORT.encode()))
    assert not link.done(start(1))
    bench.ftp().storbinary("STOR agent_program.txt", io.BytesIO(b"q\n"))
    assert not link.done(start(2))
    assert bench.controller.motions_started == 0


def test_an_invalid_program_reports_line_column_and_reason(bench):
    ftp = bench.ftp()
    ftp.storbinary("STOR p.pdl", io.BytesIO(program("  FLIP TO {20, -30}").encode()))
    line, column, reason = fetched(ftp, "p.err").decode().split(maxsplit=2)
    assert (line, int(column) > 0) == ("5", True)
    assert "FLIP" in reason
    ftp.delete("p.pdl")
    assert ftp.nlst() == ["agent_identity.json"]


def test_what_is_stored_can_be_read_back(bench):
    ftp = bench.ftp()
    text = (SHORT + "-- äöü\n").encode()
    ftp.storbinary("STOR p.pdl", io.BytesIO(text))
    assert fetched(ftp, "p.pdl") == text
    with pytest.raises(ftplib.error_perm, match="550"):
        fetched(ftp, "p.err")


@pytest.mark.parametrize(
    ("name", "size", "code"),
    [
        ("agent_identity.json", 10, "553"),
        ("p.txt", 10, "553"),
        ("../p.pdl", 2_000_000, "552"),  # there is nothing above: it is p.pdl
        ("folder/p.pdl", 10, "553"),
        ("1p.pdl", 10, "553"),
        ("p.pdl", 2_000_000, "552"),
    ],
)
def test_the_folder_refuses_invalid_names_and_sizes(bench, name, size, code):
    ftp = bench.ftp()
    with pytest.raises((ftplib.error_perm, OSError), match=f"{code}|reset|pipe"):
        ftp.storbinary(f"STOR {name}", io.BytesIO(b"x" * size))
    assert bench.ftp().nlst() == ["agent_identity.json"]


def test_nothing_outside_the_folder_can_be_read(bench):
    for name in ("/etc/passwd", "../../../../etc/passwd"):
        with pytest.raises(ftplib.error_perm, match="550"):
            fetched(bench.ftp(), name)


def test_a_full_memory_refuses_the_upload(serve):
    bench = serve(faults=[Fault("full_memory", "upload")])
    with pytest.raises(ftplib.error_perm, match="552 the program memory is full"):
        bench.store(SHORT)


def test_no_program_is_stored_while_the_arm_moves(bench):
    feedback, link = bench.feedback(), bench.trajectory()
    bench.store(LONG)
    assert link.done(start(1))
    with pytest.raises(ftplib.error_temp, match="450"):
        bench.store(SHORT, "q")
    assert not link.done(start(2))
    assert link.done(trajectory(3012))
    feedback.until_rest()
