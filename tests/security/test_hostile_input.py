"""What a controller, a file or a person may send: bounded, cleaned, and one message instead of a traceback."""

import contextlib
import json
import socket
import struct
import sys
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from agent.core import Console, InputError, fit_to_show
from agent.core.documents import LARGEST_JSON, read_json, read_yaml
from agent.recipe import examine_recipe, template
from agent.recording import LogWriter, read_log
from drivers.errors import DriverError, ProtocolError
from drivers.protocol import Identity, SampleBlock, Status
from drivers.texts import ALARM, MANY, NAME, printable
from drivers.transports.base.samples import Sequencer
from drivers.transports.cnr.address import parse_address
from drivers.transports.cnr.broker import BrokerLink
from drivers.transports.cnr.files import ProgramFolder
from drivers.transports.tcp.driver import TcpMotion, to_block
from drivers.wire.cnr import decode_joints
from drivers.wire.tcp import Samples

MIB = 1 << 20
#: Titles set, screens cleared, colours, answers asked for, bells, turned writing, halves of characters.
COMMANDS = [
    "\x1b]0;owned\x07",
    "\x1b[2J",
    "\x1b[31m",
    "\x9b31m",
    "\x1bP$q q\x1b\\",
    "\x1b[6n",
    "\a",
    "\b" * 9,
    "\u202e",
    "\ud800",
]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=8,
)


def dirty(text: str) -> set[str]:
    return {c for c in text if (ord(c) < 32 and c not in "\n\t") or 0x7F <= ord(c) < 0xA0 or 0xD800 <= ord(c) < 0xE000}


@settings(max_examples=40)
@given(st.lists(st.text() | st.sampled_from(COMMANDS), max_size=9).map("".join), st.integers(1, 50))
def test_texts_lose_control_characters_and_are_truncated(text: str, times: int):
    who = Identity(text * times, text, text, text, (text,) * 3, 0.002)
    state = Status(True, text, False, (text * times,) * (MANY + 9), 1.0, True, False, text, text, np.zeros(3))
    for told in (who.robot, who.serial, who.controller, who.version, *who.joint_names, state.mode, state.program):
        assert len(told) <= NAME
        assert not dirty(told)
        assert "\n" not in told
    assert len(state.alarms) == MANY + 1
    for shown in (*state.alarms, str(DriverError(text * times)), fit_to_show(text * times)):
        assert not dirty(shown)
    assert max(map(len, state.alarms)) <= ALARM


@pytest.mark.parametrize("command", COMMANDS)
def test_escape_sequences_do_not_reach_the_terminal(command: str, capfd: pytest.CaptureFixture[str]):
    console = Console()
    console.say(f"alarm {command}here")
    console.warn(f"alarm {command}here")
    sys.stderr.flush()
    with contextlib.suppress(AttributeError):
        console._rich.file.drain()
    shown = capfd.readouterr().err
    assert shown.count("here") == 2
    assert not dirty(shown)


def test_removes_whole_escape_sequences_and_keeps_other_text():
    assert printable("\x1b]0;owned\x07Achse \x1b[31m4\x1b[0m über\r\nTemp °C 温度") == "Achse 4 über Temp °C 温度"
    assert printable("a\nb", lines=True) == "a\nb"


def test_refuses_an_arm_of_a_thousand_joints():
    for count in (0, MANY + 1, MANY + 2, 100, 128, 255, 256, 1000, 65_535, 10**6):
        with pytest.raises(ProtocolError, match=f"names {count} joints"):
            Identity("r", "s", "c", "v", ("j",) * count, 0.002)


WHO = {"robot": "r", "serial": "s", "controller": "c", "version": "v", "joint_names": ["a"], "period": 0.002}


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 60_000,
        json.dumps({**WHO, "period": 0}).replace("0}", "9" * 5000 + "}").encode(),
        json.dumps({**WHO, "period": 0}).replace("0}", "9" * 400 + "}").encode(),
        json.dumps({**WHO, "joint_names": ["j"] * 500}).encode(),
        json.dumps({**WHO, "joint_names": None}).encode(),
        json.dumps({**WHO, "joint_names": {"a": 1}, "robot": 3}).encode(),
        json.dumps({**WHO, "period": float("nan")}).encode(),
        json.dumps({**WHO, "watchdog": "9" * 300}).encode(),
        b'{"robot": "\xff\xfe"}',
        b"null",
        b"[]",
        b"",
    ],
)
def test_an_invalid_identity_file_gives_one_message(ftp_folder: Callable[..., ProgramFolder], content: bytes):
    with pytest.raises(DriverError) as told:
        ftp_folder(agent_identity=content).machine()
    assert len(str(told.value)) < 1000


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(key=st.sampled_from(list(WHO)), value=JSON)
def test_an_identity_file_with_any_value_is_read_or_refused(ftp_folder, key: str, value: Any):
    with contextlib.suppress(DriverError):
        ftp_folder(agent_identity=json.dumps({**WHO, key: value}).encode()).machine()


def test_an_endless_identity_file_is_cut_off(ftp_folder: Callable[..., ProgramFolder]):
    folder = ftp_folder(agent_identity=b"x" * (12 * MIB))
    tracemalloc.start()
    with pytest.raises(ProtocolError, match="longer than 4 MiB"):
        folder.machine()
    assert tracemalloc.get_traced_memory()[1] < 24 * MIB  # the far end is in this process
    tracemalloc.stop()


@pytest.mark.parametrize(
    "data",
    [
        b"220-more\r\n",
        b"2" * 5000,
        b"\x00" * 4096,
        b"220 hello\r\n331 \xff\xfe\r\n",
        b"\r\n",
        b"\r" * 9000,
        b"220\r\n-1 no\r\n",
        b"999 \x1b[2J\r\n",
        b"220 a\r\n421 gone\r\n",
        bytes(range(256)) * 8,
    ],
)
def test_refuses_endless_ftp_answers(line_server: Callable[[bytes, int], int], data: bytes):
    folder = ProgramFolder(parse_address(f"127.0.0.1,ftp={line_server(data, 100_000)}"), 5.0)
    with pytest.raises(DriverError):
        folder.stored()


@given(st.binary(max_size=200) | JSON.map(lambda data: json.dumps(data).encode()))
def test_a_message_of_the_broker_is_a_sample_or_damage(payload: bytes):
    with contextlib.suppress(ProtocolError):
        decode_joints(payload)


JOINTS = {f"J{axis}": 0.0 for axis in range(1, 11)}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({**JOINTS, "time": 2**70}),
        json.dumps({**JOINTS, "time": -(2**63)}),
        json.dumps({**JOINTS, "time": 1}).replace('"time": 1', '"time": 1e999'),
        json.dumps({**JOINTS, "time": 1}).replace('"time": 1', f'"time": {"9" * 3000}'),
        json.dumps({**JOINTS, "time": 1}).replace('"time": 1', f'"time": {"9" * 4400}'),
        json.dumps({**JOINTS, "J3": None, "time": 1}),
        json.dumps({**JOINTS, "J3": 1e308 * 10, "time": 1}),
        json.dumps({**JOINTS, "time": 1, "more": "x" * 5000}),
        "[" * 3000,
        json.dumps({"J1": 0.0, "time": 1}),
        '{"J1": "\udcff"}',
    ],
)
def test_refuses_impossible_times_and_positions(text: str):
    with pytest.raises(ProtocolError):
        decode_joints(text.encode("utf-8", "surrogateescape"))


def block(first: int, count: int, joints: int, time: float = 0.0) -> SampleBlock:
    values = np.zeros((count, joints))
    return SampleBlock(np.arange(first, first + count), time + 0.002 * np.arange(first, first + count), *[values] * 5)


@pytest.mark.parametrize("then", [1, 2, 3, 4, 5, 7, 8, 16, 32, 64])
def test_a_joint_count_that_changes_in_mid_stream_ends_the_motion(then: int):
    sequencer = Sequencer()
    sequencer.accept(block(0, 10, 6))
    with pytest.raises(ProtocolError, match=f"samples of 6 joints, and now of {then}"):
        sequencer.accept(block(10, 10, then))


@pytest.mark.parametrize("time", [-(2.0**63) * 1e-9, 2.0**63 * 1e-9, np.nan, np.inf, -np.inf, 2.0**31])
@pytest.mark.parametrize("before", [0, 10])
def test_a_nan_time_ends_the_motion(time: float, before: int):
    sequencer = Sequencer()
    if before:
        sequencer.accept(block(0, before, 6))
    with pytest.raises(ProtocolError, match="that is no time"):
        sequencer.accept(block(before, 10, 6, time))


@given(
    frames=st.lists(
        st.tuples(
            st.integers(0, 2**62),
            st.integers(1, 3),
            st.integers(1, 4),
            st.sampled_from([0, 1, 2_000_000, 2**62, -(2**63), 2**63 - 1]),
            st.sampled_from([0.0, 1.0, np.nan, np.inf, 1e308, 5e-324]),
            st.integers(0, 3),
        ),
        max_size=6,
    )
)
def test_sample_frames_of_any_content_are_samples_or_a_protocol_error(frames: list[tuple[Any, ...]]):
    """As they come off the wire: the head fits the payload, the content does what it likes."""
    motion = TcpMotion(1 << 20)
    with contextlib.suppress(ProtocolError):
        for first, count, joints, time_ns, value, request in frames:
            head = Samples._HEAD.pack(first, count, joints)
            payload = (
                head + struct.pack(f"<{count}q", *[time_ns] * count) + struct.pack("<d", value) * (5 * count * joints)
            )
            motion.answered(request, to_block(Samples.unpack(payload)))
    motion.finish(None)
    for part in motion.blocks():
        assert np.isfinite(part.time).all()


METADATA = st.sampled_from(
    [
        "",
        "nan",
        "inf",
        "-1",
        "0",
        "1e999",
        "9" * 5000,
        "[" * 5000,
        "[1, null]",
        '["a"]',
        "{}",
        "[1e999]",
        f"[{'9' * 400}]",
        "\x1b[2J",
    ]
) | st.text(st.characters(exclude_categories=("Cs",)), max_size=12)


RUN_KEYS = ["cycle_starts_s", "sample_rate_hz", "lost_samples", "repeated_samples", "robot", "motion", "serial", "tool"]


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(facts=st.dictionaries(st.sampled_from(RUN_KEYS), METADATA))
def test_a_log_with_any_metadata_is_read_or_refused(tmp_path: Path, facts: dict[str, str]):
    path = tmp_path / "log.mcap"
    path.unlink(missing_ok=True)
    with LogWriter(path, ("a", "b"), robot="r", motion="m", sample_rate=500.0) as writer:
        values = np.random.default_rng(1).normal(size=(50, 2))
        writer.write(SampleBlock(np.arange(50), 1.0 + 0.002 * np.arange(50), *[values] * 5, received=1.7e9))
        writer.note(facts)
    with contextlib.suppress(InputError):
        assert len(read_log(path).t) == 50


LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 10)}]\n" for k in range(8)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (LAUGHS, "aliases written out"),
        ("a: &a [*a]\n", "stands within what it names"),
        ("a: &a {b: *a}\n", "stands within what it names"),
        ("robot: " + "x" * 20_000, "a value of 20000 characters"),
        ("# " + "x" * 300_000, "longer than 256 KiB"),
        ("[" * 200, "nested more than 50 deep"),
        ("a: " + "9" * 5000, "too many digits"),
        ("{a: " * 200, "nested more than 50 deep"),
        ("- " * 200 + "1", "nested more than 50 deep"),
        ("a: [" + "9" * 5000 + "]", "too many digits"),
        ("\0\1", "special characters are not allowed$"),
    ],
)
def test_yaml_aliases_cannot_expand_without_limit(tmp_path: Path, text: str, said: str):
    path = tmp_path / "recipe.yaml"
    path.write_text(text, encoding="utf-8")
    tracemalloc.start()
    with pytest.raises(InputError, match=said) as told:
        read_yaml(path)
    assert tracemalloc.get_traced_memory()[1] < 8 * MIB
    tracemalloc.stop()
    assert len(str(told.value)) < 500


def test_accepts_ordinary_yaml_aliases(tmp_path: Path):
    path = tmp_path / "recipe.yaml"
    path.write_text("a: &a [1, 2]\nb: *a\nc: {<<: {d: 3}}\n", encoding="utf-8")
    assert read_yaml(path)["b"] == [1, 2]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("count: 6", f"count: {'9' * 4000}"),
        ("count: 6", f"count: 0x{'f' * 9000}"),
        ("seed: 1", f"seed: -0x{'f' * 9000}"),
        ("speed: 1 m/s", f"speed: {'9' * 4000}"),
        ("speed: 1 m/s", f"speed: {'9' * 4000} m/s"),
        ("speed: 1 m/s", "speed: 1e999 m/s"),
        ("speed: 1 m/s", r'speed: "\e]0;owned\a"'),
        ("robot: comau_ns16", r'robot: "a\0b"'),
        ("robot: comau_ns16", r'robot: "\ud800"'),
        ("robot: comau_ns16", f"robot: {'x' * 9000}"),
    ],
)
def test_a_recipe_with_huge_values_gives_fault_lines(tmp_path: Path, old: str, new: str):
    path = tmp_path / "recipe.yaml"
    text = template()
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    try:
        _, faults = examine_recipe(path)
    except InputError as error:
        faults = [str(error)]
    assert faults
    for fault in faults:
        assert len(fault) < 1500
        assert not dirty(fault)


@pytest.mark.parametrize(
    "size", [*(LARGEST_JSON + k for k in (1, 4096)), *(k << 26 for k in (2, 3, 4, 5, 8, 16, 99, 999))]
)
def test_a_json_file_that_is_too_long_is_not_read(tmp_path: Path, size: int):
    path = tmp_path / "state.json"
    with open(path, "wb") as file:
        file.truncate(size)
    tracemalloc.start()
    with pytest.raises(InputError, match="longer than 64 MiB"):
        read_json(path)
    assert tracemalloc.get_traced_memory()[1] < 3 * LARGEST_JSON
    tracemalloc.stop()


@pytest.mark.parametrize(
    "data",
    [
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b"9" * 5000,
        b"-" + b"9" * 5000,
        b"\xff",
        b"",
        b"{",
        b'{"a": nul}',
        b"{'a': 1}",
        b"\x00",
        b"[1,]",
    ],
)
def test_invalid_json_gives_one_message(tmp_path: Path, data: bytes):
    path = tmp_path / "state.json"
    path.write_bytes(data)
    with pytest.raises(InputError, match="damaged"):
        read_json(path)


@pytest.mark.parametrize("kind", [b"\x30", b"\x32"])
@pytest.mark.parametrize(
    "length", [b"\xff\xff\xff\x7f", b"\x80\x80\x80\x01", b"\x80\x80\x40", b"\x80\x80\x08", b"\x81\x80\x04"]
)
def test_a_broker_packet_of_256_mib_ends_the_link(kind: bytes, length: bytes):
    """MQTT's longest, and shorter ones: after CONNACK, a PUBLISH of that length whose content does not come."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(1024)
                connection.sendall(b"\x20\x02\x00\x00" + kind + length + bytes(1000))
                with contextlib.suppress(ConnectionResetError):
                    while connection.recv(1024):
                        pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        address = parse_address(f"127.0.0.1,mqtt=127.0.0.1:{listener.getsockname()[1]}")
        with pytest.raises(DriverError, match="is gone"):
            BrokerLink(address, 0.002, 60.0, lambda _: None)
        thread.join(10)
        assert not thread.is_alive()


FORGED = [
    "\n[  12.3 s] the arm was stopped and stands",
    "\r\nagent: accepted",
    "\r[ 1.0 s] done",
    "\n \t agent: accepted",
    "\x0bwarning: none",
    "\x85agent: accepted",
    "\u2028[   1 s] done",
    "\n\n\nwarning: remove the fence",
    "\x1b[2K\n[ 12.3 s] done",
    "\n[0 s] done",
]


@pytest.mark.parametrize("text", FORGED)
def test_controller_texts_cannot_forge_lines_of_the_agent(text: str, capfd: pytest.CaptureFixture[str]):
    assert len(str(DriverError(f"refused: {text}")).splitlines()) == 1
    who = Identity(text, text, text, text, (text,), 0.002, watch_only=text, unguarded=text)
    for told in (who.robot, who.serial, who.watch_only, who.unguarded, *who.joint_names):
        assert len(told.splitlines()) == 1
    console = Console()
    console.say(f"runs{text}/a.mcap: no such file")
    with contextlib.suppress(AttributeError):
        console._rich.file.drain()
    first, *others = capfd.readouterr().err.strip().splitlines()
    assert first.startswith("[")
    assert [line for line in others if line.lstrip().startswith(("[", "agent:", "warning:"))] == []


def test_keeps_line_breaks_of_its_own_messages():
    text = "recipe.yaml:3: robot: unknown\nrecipe.yaml:7: motion: missing"
    assert fit_to_show(text) == text
