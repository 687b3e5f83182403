"""RTDE of the emulated UR against bytes written by hand after the published layout, and the published fields."""

import struct
from pathlib import Path

import numpy as np
import pytest

from fake_controller.ur.fields import INPUTS, OUTPUTS, input_type, output_type
from tests.ur_fake.clients import Primary, Rtde, clients, program
from tests.ur_fake.conftest import CB3

PUBLISHED = {
    name: line.split()[0]
    for line in (Path(__file__).parent / "published_fields.txt").read_text("utf-8").splitlines()
    if not line.startswith("#")
    for name in line.split()[1:]
}
NEWEST = (5, 25, 1, 0)
#: Fields of the vendor's guide that its client library does not list.
ONLY_IN_THE_GUIDE = {"actual_current_as_torque", "tool_digital_output_mask", "external_force_torque"}


def test_fields_have_the_published_types():
    ours = {**INPUTS, **OUTPUTS}
    assert {name: kind for name, kind in ours.items() if name not in ONLY_IN_THE_GUIDE} == PUBLISHED


@pytest.mark.parametrize(
    ("kind", "of", "count"), [("INT32", "int", 48), ("DOUBLE", "double", 48), ("BOOL", "bit", 128)]
)
def test_registers_have_the_published_types(kind, of, count):
    for way, asked in (("output", output_type), ("input", output_type), ("input", input_type)):
        assert {asked(f"{way}_{of}_register_{k}", NEWEST) for k in range(count)} == {kind}
        assert asked(f"{way}_{of}_register_{count}", NEWEST) == "NOT_FOUND"
        assert asked(f"{way}_{of}_register_{count // 2}", (5, 2, 0, 0)) == "NOT_FOUND"
    assert input_type(f"output_{of}_register_1", NEWEST) == "NOT_FOUND"


@pytest.mark.parametrize(
    ("name", "too_old", "old_enough"),
    [
        ("payload", (5, 5, 0, 0), (5, 5, 1, 0)),
        ("payload", (3, 10, 9, 0), (3, 11, 0, 0)),
        ("payload_inertia", (5, 10, 9, 0), (5, 11, 0, 0)),
        ("script_control_line", (3, 13, 0, 0), (3, 14, 0, 0)),
        ("ft_raw_wrench", (3, 15, 8, 0), (5, 9, 0, 0)),
        ("actual_current_as_torque", (5, 22, 0, 0), (5, 23, 0, 0)),
    ],
)
def test_a_field_exists_from_its_published_version_on(name, too_old, old_enough):
    assert output_type(name, too_old) == "NOT_FOUND"
    assert output_type(name, old_enough) == PUBLISHED.get(name, "VECTOR6D")


def test_the_bytes_are_the_published_ones(ur):
    with clients(Rtde(ur)) as client:
        client.send(bytes.fromhex("0005 56 0002"))  # version 2
        assert client.take(4) == bytes.fromhex("0004 56 01")
        client.send(bytes.fromhex("0003 76"))  # which controller
        assert client.take(19) == bytes.fromhex("0013 76 00000005 0000000c 00000006 0010d113")
        client.send(bytes.fromhex("0024 4f 405f400000000000") + b"timestamp,robot_mode,safe")
        assert client.take(26) == bytes.fromhex("001a 4f 00") + b"DOUBLE,INT32,NOT_FOUND"
        client.send(bytes.fromhex("0020 4f 405f400000000000") + b"timestamp,robot_mode,")  # ends with a comma
        assert client.take(16) == bytes.fromhex("0010 4f 01") + b"DOUBLE,INT32"
        client.send(bytes.fromhex("0003 53"))  # start
        assert client.take(4) == bytes.fromhex("0004 53 01")
        data = client.take(16)
        assert data[:4] == bytes.fromhex("0010 55 01")
        assert data[12:] == bytes.fromhex("00000007")  # running
        assert struct.unpack(">d", data[4:12])[0] > 60.0
        assert client.ask("P") == b"\1"


def test_one_unknown_name_makes_the_recipe_void(ur):
    with clients(Rtde(ur)) as client:
        client.ask("V", b"\0\2")
        assert client.ask("O", struct.pack(">d", 500) + b"timestamp,no_such") == b"\0DOUBLE,NOT_FOUND"
        assert client.ask("S") == b"\0"
        assert client.ask("V", b"\0\3") == b"\0"
        client.package("X")
        assert client.receive()[0] == "M"


def test_an_input_belongs_to_the_client_that_named_it_first(ur):
    name = b"input_int_register_24"
    with clients(Rtde(ur), Rtde(ur)) as (first, second):
        first.ask("V", b"\0\2")
        assert first.ask("I", name) == b"\1INT32"
        assert first.ask("I", name + b",input_double_register_24") == b"\2INT32,DOUBLE"
        assert second.ask("I", name) == b"\0IN_USE"
        assert second.ask("I", b"output_int_register_24") == b"\0NOT_FOUND"
        first.close()
        while (answer := second.ask("I", name)) != b"\1INT32":
            assert answer == b"\0IN_USE"


def test_inputs_come_in_and_are_kept(ur):
    names = ["input_int_register_24", "input_bit_register_70", "input_double_register_3", "input_bit_registers0_to_31"]
    with clients(Rtde(ur, *names)) as client:
        recipe = client.ask("I", ",".join(names).encode())
        client.package("U", recipe[:1] + struct.pack(">i?dI", -7, True, 2.5, 0x80000001))
        sample = client.until(lambda sample: sample[names[0]] == -7)[-1]
        assert [sample[name] for name in names] == [-7, True, 2.5, 0x80000001]
        client.package("U", recipe[:1] + b"short")
        kind, content = client.receive()
        while kind == "U":
            kind, content = client.receive()
        assert kind == "M"
        assert content[-1] == 1  # an error


@pytest.mark.parametrize(
    ("version", "asked", "step"),
    [((5, 12, 6, 0), 0, 2), ((5, 12, 6, 0), 125, 8), (CB3, 125, 8), (CB3, 500, 8), ((5, 12, 6, 0), 300, 2)],
)
def test_a_lower_rate_sends_every_nth_cycle(start_ur, version, asked, step):
    with clients(Rtde(start_ur(version=version).address, "timestamp", frequency=asked)) as client:
        times = [client.sample()["timestamp"] for _ in range(50)]
    np.testing.assert_allclose(np.diff(times), step * 1e-3, atol=1e-9)


def test_target_moment_follows_the_payload_that_is_set_and_current_does_not(start_ur):
    """Gravity of the model is in target_moment, and taken out of the field that is no measurement."""
    names = ("actual_current", "target_moment", "actual_current_as_torque", "payload", "payload_cog")
    ur = start_ur(version=NEWEST)
    gain = 101 * np.array([0.1005, 0.1005, 0.1003, 0.0802, 0.0812, 0.08])
    with clients(Rtde(ur.address, *names), Primary(ur.address)) as (client, primary):
        before = client.sample()
        primary.send(program("set_target_payload(5, [0, 0, 0.1], [0, 0, 0, 0, 0, 0])").encode())
        after = client.until(lambda sample: sample["payload"] == 5)[-1]
    gravity = gain * before["actual_current"] - before["actual_current_as_torque"]
    np.testing.assert_allclose(gravity, before["target_moment"], atol=0.5)
    np.testing.assert_allclose(after["actual_current"], before["actual_current"], atol=0.5)
    assert abs(after["target_moment"][1] - before["target_moment"][1]) > 15
    np.testing.assert_array_equal(after["payload_cog"], [0, 0, 0.1])
