"""The register map: golden registers, the published table, and what damage does."""

import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.errors import ProtocolError
from drivers.wire import modbus as wire

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "modbus-registers.csv"


def registers(text: str) -> list[int]:
    """Registers in hex, and the CRC-32 after them, worked out here from the bytes."""
    body = bytes.fromhex(text)
    data = body + zlib.crc32(body).to_bytes(4, "big")
    return [int.from_bytes(data[at : at + 2], "big") for at in range(0, len(data), 2)]


def test_the_published_map_is_the_one_in_use():
    assert wire.map_as_csv() == DOCUMENT.read_text(encoding="utf-8")


def test_blocks_do_not_overlap_and_fit_into_one_message():
    end = 0
    for block in sorted(wire.BLOCKS, key=lambda block: block.address):
        assert block.address >= end
        assert block.registers <= (wire.MAX_READ if block.access == "read" else wire.MAX_WRITE)
        end = block.end
    assert end <= wire.RING
    assert wire.RING + wire.RING_REGISTERS <= 65536


GOLDEN = [
    (wire.HEARTBEAT, {"session": 0x01020304, "count": 7, "taken": 0x10001}, "01020304 0007 00010001"),
    (
        wire.PROGRESS,
        {
            "heartbeat": 3,
            "session": 0x01020304,
            "state": 1,
            "motion": bytes(range(16)),
            "samples": 70_000,
            "oldest": 0,
            "reason": 0,
        },
        "0003 01020304 0001 000102030405060708090a0b0c0d0e0f 00011170 00000000 0000",
    ),
    (
        wire.COMMAND,
        {
            "session": 0x01020304,
            "request": 9,
            "command": 5,
            "watchdog": 200,
            "name": "pé",
            "size": 258,
            "checksum": b"\xab" * 32,
            "motion": bytes(range(16)),
        },
        "01020304 0009 0005 000000c8 70c3a9" + "00" * 29 + "00000102" + "ab" * 32 + "000102030405060708090a0b0c0d0e0f",
    ),
    (
        wire.STATUS,
        {
            "flags": wire.Flag.DRIVES_ON | wire.Flag.CELL_CLOSED | wire.Flag.EMULATOR,
            "mode": 1,
            "alarms": 0,
            "override": 0.5,
            "position": (1.0, -2.0),
            "program": "p",
            "checksum": b"\x01" * 32,
        },
        "0015 0001 0000 3f000000 3ff0000000000000 c000000000000000" + "00" * 80 + "70" + "00" * 31 + "01" * 32,
    ),
    (
        wire.UPLOAD,
        {"session": 1, "offset": 216, "count": 3, "data": b"abc"},
        "00000001 000000d8 0003 616263" + "00" * 213,
    ),
]


@pytest.mark.parametrize(("block", "values", "expected"), GOLDEN, ids=lambda value: getattr(value, "name", ""))
def test_golden_registers(block, values, expected):
    assert block.pack(**values) == registers(expected)
    unpacked = block.unpack(registers(expected))
    for name, value in values.items():
        got = unpacked[name]
        assert got[: len(value)] == value if isinstance(value, bytes | tuple) else got == value


def test_golden_registers_of_a_sample():
    columns = [np.array([[float(k)]]) for k in range(1, 6)]
    (row,) = wire.pack_slots(258, np.array([2_000_000]), columns)
    expected = registers("00000102 00000000001e8480 3f800000 40000000 40400000 40800000 40a00000")
    assert row.tolist() == expected
    assert len(expected) == wire.slot_registers(1)
    slots = wire.unpack_slots(np.array([expected]), 1, 258)
    assert slots.sequence.tolist() == [258]
    assert slots.time_ns.tolist() == [2_000_000]
    assert slots.values[:, 0, 0].tolist() == [1, 2, 3, 4, 5]


@given(st.sampled_from(range(len(GOLDEN))), st.data())
@settings(max_examples=200, deadline=None)
def test_detects_every_flipped_bit(chosen, data):
    block, values, _ = GOLDEN[chosen]
    damaged = block.pack(**values)
    bit = data.draw(st.integers(0, 16 * len(damaged) - 1))
    damaged[bit // 16] ^= 1 << bit % 16
    with pytest.raises(ProtocolError, match="damaged"):
        block.unpack(damaged)


@given(st.integers(1, 12), st.integers(1, 20), st.integers(0, 2**32 - 100), st.data())
@settings(max_examples=100, deadline=None)
def test_samples_up_to_the_first_that_is_damaged(joints, count, first, data):
    random = np.random.default_rng(count)
    columns = [random.normal(size=(count, joints)) for _ in range(5)]
    times = np.arange(count) * 2_000_000 + 2**40
    rows = wire.pack_slots(first, times, columns)
    bad = data.draw(st.integers(0, count - 1))
    column = data.draw(st.integers(0, rows.shape[1] - 1))
    rows[bad, column] ^= 1 << data.draw(st.integers(0, 15))
    slots = wire.unpack_slots(rows, joints, first)
    np.testing.assert_array_equal(slots.sequence, np.arange(first, first + bad))
    np.testing.assert_array_equal(slots.time_ns, times[:bad])
    for got, sent in zip(slots.values, columns, strict=True):
        np.testing.assert_allclose(got, sent[:bad], rtol=1e-6)


def test_an_empty_slot_is_no_sample():
    empty = np.zeros((3, wire.slot_registers(2)), np.uint16)
    assert len(wire.unpack_slots(empty, 2, 0).sequence) == 0


def test_long_text_is_cut_at_a_character():
    text = wire.Text(5)
    assert text.unpack(BytesIO(text.pack("ééé"))) == "éé"


def test_invalid_utf8_is_a_protocol_error():
    with pytest.raises(ProtocolError, match="UTF-8"):
        wire.Text(4).unpack(BytesIO(b"\xff\xfe\0\0"))
