"""Frames on a line: lean samples, and a decoder that goes on after damage."""

import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from drivers.errors import ConfigurationError, ProtocolError
from drivers.transports.base.ports import parse_port
from drivers.wire import frames as tcp, serial as wire

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "wire-serial.md"


def test_golden_bytes_of_lean_samples():
    columns = [np.array([[float(k)], [-float(k)]]) for k in range(1, 6)]
    body = bytes.fromhex(
        "43414c4b 01 92 0000 43000000 00000000  0300000000000000 0200 01  80841e0000000000 00093d0000000000"
        "  0000803f 000080bf  00000040 000000c0  00004040 000040c0  00008040 000080c0  0000a040 0000a0c0"
    )
    expected = body + zlib.crc32(body).to_bytes(4, "little")
    message = wire.LeanSamples(3, np.array([2_000_000, 4_000_000]), *columns)
    assert tcp.encode(message) == expected
    (frame,) = wire.HuntingDecoder().feed(expected)
    decoded = wire.decode(frame)
    assert decoded.first == 3
    np.testing.assert_array_equal(decoded.time_ns, [2_000_000, 4_000_000])
    np.testing.assert_array_equal(decoded.reference_velocity, columns[4])


@given(st.binary(max_size=200))
@settings(max_examples=300, deadline=None)
def test_any_payload_decodes_or_is_a_protocol_error(payload):
    try:
        message = wire.decode(tcp.Frame(wire.LeanSamples.TYPE, 0, payload))
    except ProtocolError:
        return
    assert len(payload) == wire.LeanSamples.size(*message.position.shape)


@given(st.lists(st.binary(max_size=60), min_size=1, max_size=6), st.data())
@settings(max_examples=200, deadline=None)
def test_whole_frames_survive_whatever_is_between_them(noises, data):
    """Noise without the first byte of a frame in it; a frame is lost only where it is itself damaged."""
    noises = [noise.replace(tcp.MAGIC[:1], b"-") for noise in noises]
    stream = b"".join(noise + tcp.encode(tcp.Fetch(k, 1), k + 1) for k, noise in enumerate(noises))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=8)))
    decoder = wire.HuntingDecoder()
    frames = []
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        frames += decoder.feed(stream[begin:end])
    assert [frame.request for frame in frames] == list(range(1, len(noises) + 1))
    assert decoder.rejected == sum(map(len, noises))


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_a_damaged_frame_costs_nothing_but_itself(data):
    parts = [tcp.encode(tcp.Fetch(k, 1), k + 1) for k in range(4)]
    bad = data.draw(st.integers(0, 2))
    at = data.draw(st.integers(0, 8 * len(parts[0]) - 1))
    damaged = bytearray(parts[bad])
    damaged[at // 8] ^= 1 << at % 8
    parts[bad] = bytes(damaged)
    # Nothing follows: a damaged length that announces more than ever comes must not hold up what has come.
    frames = list(wire.HuntingDecoder().feed(b"".join(parts)))
    assert [frame.request for frame in frames] == [k + 1 for k in range(4) if k != bad]


@given(st.binary(max_size=2000))
@settings(max_examples=100, deadline=None)
def test_noise_is_not_buffered(noise):
    decoder = wire.HuntingDecoder(64)
    for byte in noise:
        list(decoder.feed(bytes([byte])))
        assert decoder.pending <= tcp.HEADER.size + 64 + tcp.TRAILER.size


def test_computes_the_capacity_of_a_line():
    assert wire.samples_per_second(921_600, 6) > 500
    assert wire.samples_per_second(115_200, 6) < 100
    assert wire.frame_time(115_200, 1152) == pytest.approx(0.1)
    text = DOCUMENT.read_text(encoding="utf-8")
    for baud in (9600, 115_200, 921_600):
        row = re.search(rf"\| {baud:,} \| (\d+) \| (\d+) ms \|".replace(",", " "), text)
        assert row is not None, baud
        assert int(row[1]) == int(wire.samples_per_second(baud, 6))
        assert int(row[2]) == max(500, round(3000 * wire.frame_time(baud)))


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("/dev/ttyUSB0", ("/dev/ttyUSB0", 115_200, "frames")),
        ("COM3,921600", ("COM3", 921_600, "frames")),
        ("/dev/ttyS1, 9600, rtu", ("/dev/ttyS1", 9600, "rtu")),
    ],
)
def test_addresses(address, expected):
    port = parse_port(address)
    assert (port.port, port.baud, port.protocol) == expected


@pytest.mark.parametrize(
    "address", ["", ",115200", "/dev/ttyS1,fast", "/dev/ttyS1,0", "/dev/ttyS1,9600,tcp", "a,9600,rtu,x"]
)
def test_refuses_invalid_addresses(address):
    with pytest.raises(ConfigurationError, match="port,baud,protocol is expected"):
        parse_port(address)
