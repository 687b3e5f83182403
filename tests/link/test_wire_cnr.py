"""The frames of the socket programs and the C5G Open node: golden bytes written by hand from their layouts."""

import itertools
import json
import re

import pytest
from hypothesis import given, settings, strategies as st

from drivers.errors import ProtocolError
from drivers.wire import cnr

# Floats by hand: 1.0 = 3f800000, 0.5 = 3f000000, 20.0 = 41a00000, -90.0 = c2b40000, 2.0 = 40000000.
ZEROS = "00000000 "
ONES = "0000803f "

GOLDEN = [
    (
        cnr.Message(3001, 2, 0, cnr.Point(1, 0, 258, 20.0, 0.5, (1.0, 2.0, -90.0) + (0.0,) * 7, 5)),
        # length 76, type 3001 = 0bb9, request, no reply code; arm, queue, sequence number, tolerance, speed
        "4c000000 b90b0000 02000000 00000000  01000000 00000000 02010000 0000a041 0000003f"
        # ten joints, digital output
        " 0000803f 00000040 0000b4c2" + 7 * ZEROS + "05000000",
    ),
    (
        cnr.Message(3010, 3, 1, cnr.Point(1, 2, 7)),
        "4c000000 c20b0000 03000000 01000000  01000000 02000000 07000000" + 12 * ZEROS + ZEROS,
    ),
    (cnr.Message(1, 2, 0, cnr.Point(1)), "4c000000 01000000 02000000 00000000  01000000" + 15 * ZEROS),
    (
        cnr.Message(
            3004,
            2,
            0,
            cnr.Feedback(
                1,
                (1.0,) * 6,
                (0.5,) * 6,
                (0.0, 0.0, 20.0, 0.0, 0.0, 0.0),
                (2.0,) * 10,
                (-90.0,) * 10,
                (1.0,) * 6,
                258,
                65536,
                1,
            ),
        ),
        # length 204, type 3004 = 0bbc, request; arm, base, user and tool frames
        "cc000000 bc0b0000 02000000 00000000  01000000"
        + 6 * ONES
        + 6 * "0000003f "
        + (2 * ZEROS + "0000a041 " + 3 * ZEROS)
        # joints, currents, Cartesian position, last point, time, moving
        + 10 * "00000040 "
        + 10 * "0000b4c2 "
        + 6 * ONES
        + "02010000 00000100 01000000",
    ),
    (
        cnr.Message(13, 2, 0, cnr.StatusMessage(1, 0, 62513, 1, 0, 2, -1)),
        "28000000 0d000000 02000000 00000000  01000000 00000000 31f40000 01000000 00000000 02000000 ffffffff",
    ),
]


def swapped(data: bytes) -> bytes:
    """The same fields from a big-endian controller: every field has four bytes."""
    return b"".join(data[k : k + 4][::-1] for k in range(0, len(data), 4))


@pytest.mark.parametrize(("message", "expected"), GOLDEN, ids=lambda v: getattr(v, "type", ""))
def test_golden_bytes(message, expected):
    data = bytes.fromhex(expected)
    assert int.from_bytes(data[:4], "little") == len(data) - 4
    assert cnr.encode(message) == data
    decoder = cnr.MessageDecoder()
    assert list(decoder.feed(data)) == [message]
    assert (decoder.order, decoder.pending) == (cnr.LITTLE, 0)


@pytest.mark.parametrize(("message", "expected"), GOLDEN, ids=lambda v: getattr(v, "type", ""))
def test_a_big_endian_controller_is_known_by_its_first_length(message, expected):
    data = swapped(bytes.fromhex(expected))
    assert cnr.encode(message, cnr.BIG) == data
    decoder = cnr.MessageDecoder()
    assert list(decoder.feed(data)) == [message]
    assert decoder.order == cnr.BIG


@given(cuts=st.lists(st.integers(0, 600), max_size=8))
def test_decodes_messages_split_anywhere(cuts):
    messages = [message for message, _ in GOLDEN]
    data = b"".join(bytes.fromhex(text) for _, text in GOLDEN)
    edges = sorted({0, len(data), *(cut for cut in cuts if cut < len(data))})
    decoder = cnr.MessageDecoder()
    got = [m for a, b in itertools.pairwise(edges) for m in decoder.feed(data[a:b])]
    assert got == messages
    assert decoder.pending == 0


@settings(max_examples=300)
@given(data=st.binary(max_size=300))
def test_garbage_gives_a_message_or_a_protocol_error(data):
    decoder = cnr.MessageDecoder()
    try:
        messages = list(decoder.feed(data))
    except ProtocolError as error:
        with pytest.raises(ProtocolError, match=re.escape(str(error))):
            list(decoder.feed(b""))
        return
    assert decoder.pending + sum(len(cnr.encode(m, decoder.order)) for m in messages) == len(data)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"HTTP/1.1 400 Bad", "not the socket programs"),
        # The point of the programs before fly_tolerance had 72 bytes.
        (bytes.fromhex("48000000 b90b0000 02000000 00000000"), "72 bytes; 76 are expected: is an older version"),
        (bytes.fromhex("4c000000 0d000000 02000000 00000000"), "76 bytes; 40 are expected"),
        (bytes(4), "not the socket programs"),
    ],
)
def test_names_other_protocols(data, said):
    with pytest.raises(ProtocolError, match=said):
        list(cnr.MessageDecoder().feed(data))


def test_whole_messages_before_the_damage_are_given():
    status = bytes.fromhex(GOLDEN[-1][1])
    messages = cnr.MessageDecoder().feed(status + b"\xff" * 8)
    assert next(messages) == GOLDEN[-1][0]
    with pytest.raises(ProtocolError):
        next(messages)


def test_arrays_have_their_lengths():
    with pytest.raises(ValueError, match="Point has 6 values; 10"):
        cnr.encode(cnr.Message(3001, 2, 0, cnr.Point(joints=(0.0,) * 6)))


NODE = (  # tabs and line ends as the node's JSON writer makes them
    b'{\n\t"J1" : 12.5,\n\t"J10" : 0.0,\n\t"J2" : -45,\n\t"J3" : 1e-3,\n\t"J4" : 0,\n\t"J5" : 0,\n\t"J6" : 7,\n'
    b'\t"J7" : 0.0,\n\t"J8" : 0.0,\n\t"J9" : 0.0,\n\t"time" : 1700000000123456\n}\x00'
)


def test_decodes_a_topic_written_by_the_node():
    assert cnr.decode_joints(NODE) == (1700000000123456, (12.5, -45.0, 0.001, 0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 0.0))


def test_encodes_a_topic_like_the_node():
    payload = cnr.encode_joints((1.5, -2.0), 12)
    assert payload.endswith(b"\0")
    assert json.loads(payload[:-1]) == {**{f"J{k}": 0.0 for k in range(3, 11)}, "J1": 1.5, "J2": -2.0, "time": 12}


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\0",
        b"{}",
        b"[1]",
        b"\xff\xfe\0",
        NODE.replace(b'"J6"', b'"K6"'),
        NODE.replace(b"12.5", b"NaN"),
        NODE.replace(b"12.5", b'"x"'),
        NODE.replace(b"1700000000123456", b"null"),
        NODE.replace(b"1700000000123456", b"1e999"),
        NODE[:-20],
        b"[" * 100_000,
    ],
)
def test_other_payloads_are_protocol_errors(payload):
    with pytest.raises(ProtocolError, match="C5G Open"):
        cnr.decode_joints(payload)


@given(values=st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=10), time=st.integers(0, 2**53))
def test_topics_round_trip(values, time):
    assert cnr.decode_joints(cnr.encode_joints(values, time)) == (time, (*values, *[0.0] * (10 - len(values))))
