"""The binary link's frames: golden bytes written by hand, any split, any damage."""

import re
import zlib

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.errors import ProtocolError
from drivers.wire import tcp
from drivers.wire.fields import MAX_TEXT


def with_checksum(hexadecimal: str) -> bytes:
    body = bytes.fromhex(hexadecimal)
    return body + zlib.crc32(body).to_bytes(4, "little")


HEARTBEAT = bytes.fromhex("43414c4b 01 0a 0000 00000000 00000000 f7f50fd0")

GOLDEN = [
    (tcp.Heartbeat(), 0, HEARTBEAT),
    (
        tcp.Hello(version=1, watchdog_ms=200, client="ag"),
        7,
        with_checksum("43414c4b 01 01 0000 0a000000 07000000  0100 c8000000 0200 6167"),
    ),
    (tcp.Welcome(1, 200), 7, with_checksum("43414c4b 01 81 0000 06000000 07000000  0100 c8000000")),
    (tcp.Identify(), 2, with_checksum("43414c4b 01 02 0000 00000000 02000000")),
    (
        tcp.IdentityReply("r", "s1", "c", "v", ("a", "bc"), 0.5),
        2,
        with_checksum(
            "43414c4b 01 82 0000 1d000000 02000000  0100 72  0200 7331  0100 63  0100 76"
            "  02 0100 61 0200 6263  000000000000e03f"
        ),
    ),
    (tcp.AskStatus(), 3, with_checksum("43414c4b 01 03 0000 00000000 03000000")),
    (
        tcp.StatusReply(True, "auto", False, (), 1.0, True, False, "p", "ab", (2.0,), True),
        3,
        with_checksum(
            "43414c4b 01 83 0000 24000000 03000000  01 0400 6175746f 00 00 000000000000f03f 01 00"
            "  0100 70  0200 6162  01 0000000000000040  01"
        ),
    ),
    (tcp.AskTemperatures(), 3, with_checksum("43414c4b 01 0b 0000 00000000 03000000")),
    (tcp.TemperaturesReply((25.5,)), 3, with_checksum("43414c4b 01 8b 0000 09000000 03000000  01 0000000000803940")),
    (tcp.AskFrames(), 3, with_checksum("43414c4b 01 0c 0000 00000000 03000000")),
    (
        tcp.FramesReply((0.5,), (), (-2.0, 1.0)),
        3,
        with_checksum(
            "43414c4b 01 8c 0000 1b000000 03000000  01 000000000000e03f  00  02 00000000000000c0 000000000000f03f"
        ),
    ),
    (
        tcp.UploadBegin("p", 258, "ab"),
        4,
        with_checksum("43414c4b 01 04 0000 0b000000 04000000  0100 70 02010000 0200 6162"),
    ),
    (
        tcp.UploadBlock(256, b"\x00\xff"),
        5,
        with_checksum("43414c4b 01 05 0000 0a000000 05000000  00010000 02000000 00ff"),
    ),
    (tcp.UploadEnd(), 6, with_checksum("43414c4b 01 06 0000 00000000 06000000")),
    (tcp.Stored("p", "ab"), 6, with_checksum("43414c4b 01 86 0000 07000000 06000000  0100 70 0200 6162")),
    (
        tcp.Start("p", "ab", bytes(range(16))),
        8,
        with_checksum("43414c4b 01 07 0000 17000000 08000000  0100 70 0200 6162 000102030405060708090a0b0c0d0e0f"),
    ),
    (
        tcp.Started(bytes(range(16))),
        8,
        with_checksum("43414c4b 01 87 0000 10000000 08000000  000102030405060708090a0b0c0d0e0f"),
    ),
    (tcp.Stop(), 9, with_checksum("43414c4b 01 08 0000 00000000 09000000")),
    (tcp.Done(), 9, with_checksum("43414c4b 01 80 0000 00000000 09000000")),
    (tcp.Fetch(258, 3), 10, with_checksum("43414c4b 01 09 0000 0c000000 0a000000  0201000000000000 03000000")),
    (
        tcp.End(1, 5, "on\u00e9"),
        0,
        with_checksum("43414c4b 01 91 0000 10000000 00000000  0100 0500000000000000 0400 6f6ec3a9"),
    ),
    (
        tcp.Refused(6, 12, 3, "no"),
        11,
        with_checksum("43414c4b 01 ff 0000 0e000000 0b000000  0600 0c000000 03000000 0200 6e6f"),
    ),
]


@pytest.mark.parametrize(("message", "request_id", "expected"), GOLDEN, ids=lambda v: type(v).__name__)
def test_golden_bytes(message, request_id, expected):
    assert tcp.encode(message, request_id) == expected
    (frame,) = tcp.FrameDecoder(1000).feed(expected)
    assert frame.request == request_id
    assert tcp.decode(frame) == message


def test_golden_bytes_of_samples():
    one_joint = [np.array([[float(k)], [-float(k)]]) for k in range(1, 6)]
    message = tcp.Samples(3, np.array([2_000_000, 4_000_000]), *one_joint)
    expected = with_checksum(
        "43414c4b 01 90 0000 6b000000 00000000  0300000000000000 0200 01  80841e0000000000 00093d0000000000"
        "  000000000000f03f 000000000000f0bf  0000000000000040 00000000000000c0  0000000000000840 00000000000008c0"
        "  0000000000001040 00000000000010c0  0000000000001440 00000000000014c0"
    )
    assert tcp.encode(message) == expected
    (frame,) = tcp.FrameDecoder(1000).feed(expected)
    decoded = tcp.decode(frame)
    assert decoded.first == 3
    for name in ("time_ns", "position", "velocity", "torque", "reference_position", "reference_velocity"):
        np.testing.assert_array_equal(getattr(decoded, name), getattr(message, name))


def test_every_message_has_golden_bytes():
    assert {type(message) for message, _, _ in GOLDEN} | {tcp.Samples} == set(tcp.MESSAGES.values())


@given(st.lists(st.integers(0, len(GOLDEN) - 1), min_size=1, max_size=8), st.data())
@settings(max_examples=100, deadline=None)
def test_any_split_gives_the_same_frames(chosen, data):
    stream = b"".join(GOLDEN[k][2] for k in chosen)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=12)))
    decoder = tcp.FrameDecoder(1000)
    frames = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        frames += decoder.feed(stream[begin:end])
    assert [tcp.decode(frame) for frame in frames] == [GOLDEN[k][0] for k in chosen]
    assert decoder.pending == 0


@given(st.integers(0, len(GOLDEN) - 1), st.data())
@settings(max_examples=200, deadline=None)
def test_a_flipped_bit_never_gives_a_frame(chosen, data):
    stream = bytearray(GOLDEN[chosen][2])
    bit = data.draw(st.integers(0, 8 * len(stream) - 1))
    stream[bit // 8] ^= 1 << bit % 8
    decoder = tcp.FrameDecoder(1000)
    frames = []
    try:
        frames = list(decoder.feed(bytes(stream)))
    except ProtocolError as first:
        with pytest.raises(ProtocolError, match=re.escape(str(first))):
            list(decoder.feed(HEARTBEAT))
    assert frames == []


@given(st.binary(max_size=400))
@settings(max_examples=300, deadline=None)
def test_noise_is_refused_and_not_buffered(noise):
    decoder = tcp.FrameDecoder(64)
    try:
        for byte in noise:
            list(decoder.feed(bytes([byte])))
            assert decoder.pending <= tcp.HEADER.size + 64 + tcp.TRAILER.size
    except ProtocolError:
        assert decoder.pending == 0


@given(st.sampled_from(sorted(tcp.MESSAGES)), st.binary(max_size=300))
@settings(max_examples=500, deadline=None)
def test_any_payload_decodes_or_is_a_protocol_error(kind, payload):
    try:
        message = tcp.decode(tcp.Frame(kind, 0, payload))
    except ProtocolError:
        return
    assert message.pack() == payload


def test_frames_before_the_damage_are_not_lost():
    decoder = tcp.FrameDecoder(100)
    frames = decoder.feed(HEARTBEAT + HEARTBEAT + b"GARBAGE")
    assert [next(frames).type, next(frames).type] == [tcp.Heartbeat.TYPE] * 2
    with pytest.raises(ProtocolError, match="GARB"):
        next(frames)


def test_another_protocol_is_recognised_by_its_first_bytes():
    with pytest.raises(ProtocolError, match="not the calibration link"):
        list(tcp.FrameDecoder(100).feed(b"HTTP/1.1 400 Bad Request"))


def test_reports_another_protocol_version():
    with pytest.raises(ProtocolError, match="version 2"):
        list(tcp.FrameDecoder(100).feed(HEARTBEAT[:4] + b"\x02" + HEARTBEAT[5:]))


def test_refuses_a_too_large_announced_length():
    with pytest.raises(ProtocolError, match="4294967295 bytes; at most 100"):
        list(tcp.FrameDecoder(100).feed(bytes.fromhex("43414c4b 01 0a 0000 ffffffff 00000000")))


def test_refuses_an_unknown_message_type():
    with pytest.raises(ProtocolError, match="0x55"):
        tcp.decode(tcp.Frame(0x55, 0, b""))


def test_long_text_is_cut_at_a_character():
    message = tcp.End(0, 0, "é" * MAX_TEXT)
    (frame,) = tcp.FrameDecoder(2 * MAX_TEXT).feed(tcp.encode(message))
    assert tcp.decode(frame).message == "é" * (MAX_TEXT // 2)
