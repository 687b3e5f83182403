"""Passwords: refused in addresses, read from private files, and absent from all texts and files of a run."""

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from agent.core import InputError, write_atomically
from agent.link import answering
from agent.recipe import load_recipe
from drivers.errors import ConfigurationError, DriverError
from drivers.registry import available, create
from drivers.secrets import read_secret
from drivers.texts import hidden_forms, hide, hide_all, public_address
from drivers.transports.cnr.address import parse_address
from drivers.transports.cnr.files import ProgramFolder
from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer
from tests import warm
from tests.app.conftest import RECIPE

PLANTED = "hunter<2>&'zwölf"


@pytest.fixture(autouse=True)
def nothing_known():
    """Forget the passwords that a test has read before the next test."""
    before = set(hidden_forms)
    yield
    hidden_forms.clear()
    hidden_forms.update(before)


def recipe(address: str, driver: str = "tcp") -> str:
    """The smallest job."""
    text = RECIPE.format(address=address, cycles=1, motions=1, speed="0.5 m/s", gate=0.03)
    return text.replace("tcp", driver).replace("population: 8, generations: 3", "population: 4, generations: 1")


def agent(folder: Path, *arguments: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return warm.run("agent", *arguments, cwd=folder, **environment)


def leaks(folder: Path, secret: str) -> list[str]:
    """Files below a folder that hold a secret, in any form in which a text may hold it."""
    import html
    import json

    forms = {secret, json.dumps(secret)[1:-1], html.escape(secret), repr(secret)[1:-1]}
    found = [path for path in folder.rglob("*") if path.is_file()]
    assert found
    return [str(path) for path in found if any(form.encode() in path.read_bytes() for form in forms)]


@pytest.mark.parametrize("driver", available())
@pytest.mark.parametrize(
    "address",
    [
        "joe:{}@127.0.0.1:9100",
        "tcp://joe:{}@127.0.0.1:9100",
        "127.0.0.1:9100?password={}",
        "127.0.0.1,user=joe,password={}",
        "127.0.0.1,user=joe,PASSWD = {}",
        "127.0.0.1,mqtt=joe:{}@lpc:1883",
        "127.0.0.1,password_from=env:X,token={}",
    ],
)
def test_refuses_an_address_with_a_password_without_printing_it(driver: str, address: str):
    with pytest.raises(ConfigurationError, match="password_from=env:NAME") as refusal:
        create(driver, address.format(PLANTED))
    assert PLANTED not in str(refusal.value)


@pytest.mark.parametrize("command", [["check", "--json"], ["calibrate"]])
def test_a_refused_recipe_password_is_stored_nowhere(tmp_path: Path, command: list[str]):
    text = recipe(f"joe:{PLANTED}@127.0.0.1:9100")
    (tmp_path / "recipe.yaml").write_text(text, encoding="utf-8")
    run = agent(tmp_path, command[0], "recipe.yaml", *command[1:])
    assert run.returncode == 2
    said = run.stdout + run.stderr
    assert "password_from" in said
    assert not any(form in said for form in (PLANTED, "hunter"))
    assert leaks(tmp_path, PLANTED) == [str(tmp_path / "recipe.yaml")]


def test_a_password_under_a_wrong_recipe_key_is_not_printed(tmp_path: Path):
    text = recipe("127.0.0.1:9100").replace("robot:", 'controler: "joe:hunter22@host"\nrobot:')
    (tmp_path / "recipe.yaml").write_text(text.replace("count: 6", 'count: "password=hunter22"'), encoding="utf-8")
    run = agent(tmp_path, "check", "recipe.yaml")
    assert run.returncode == 2
    assert "hunter22" not in run.stdout + run.stderr


def test_init_writes_no_password(tmp_path: Path):
    run = agent(tmp_path, "init", "recipe.yaml", "--controller", f"joe:{PLANTED}@127.0.0.1:9100")
    assert run.returncode == 2
    assert PLANTED not in run.stdout + run.stderr
    assert not (tmp_path / "recipe.yaml").exists()


def test_passwords_come_from_the_environment_a_file_and_the_keyring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CELL_FTP", "from the environment")
    assert read_secret("env:CELL_FTP") == "from the environment"
    path = tmp_path / "ftp.secret"
    path.write_text("from a file\n", encoding="utf-8")
    path.chmod(0o600)
    assert read_secret(f"file:{path}") == "from a file"

    class Keyring:
        @staticmethod
        def get_password(service: str, user: str) -> str | None:
            return "from the keyring" if (service, user) == ("cell", "joe") else None

    monkeypatch.setitem(sys.modules, "keyring", Keyring)
    assert read_secret("keyring:cell/joe") == "from the keyring"
    assert hide("a from the keyring b") == "a *** b"
    with pytest.raises(ConfigurationError, match="keyring set"):
        read_secret("keyring:cell/jim")


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o660, 0o610, 0o601, 0o602, 0o620, 0o666, 0o677])
def test_a_file_that_others_can_read_is_not_used(tmp_path: Path, mode: int):
    path = tmp_path / "ftp.secret"
    path.write_text("hunter22", encoding="utf-8")
    path.chmod(mode)
    with pytest.raises(ConfigurationError, match="chmod 600"):
        read_secret(f"file:{path}")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"abc", "fewer than 4"),
        (b"x" * 5000, "longer than 4096"),
        (b"\xff\xff\xff\xff", "not UTF-8"),
        (b"two\nlines", "typed"),
    ],
)
def test_reports_an_invalid_password_file(tmp_path: Path, content: bytes, said: str):
    path = tmp_path / "ftp.secret"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(ConfigurationError, match=said) as refusal:
        read_secret(f"file:{path}")
    assert "two" not in str(refusal.value)


def test_refuses_a_folder_or_fifo_as_password_file(tmp_path: Path):
    os.mkfifo(tmp_path / "fifo", 0o600)
    (tmp_path / "link").symlink_to("/nowhere")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "folder").symlink_to(tmp_path)
    said_of = {
        "": "a directory",
        "folder": "a directory",
        "fifo": "not a file",
        "/dev/null": "not a file",
        "/dev/zero": "not a file",
        "none": "cannot be read",
        "link": "cannot be read",
        "loop": "cannot be read",
        "x" * 300: "cannot be read",
    }
    for name, said in said_of.items():
        with pytest.raises(ConfigurationError, match=said):
            read_secret(f"file:{tmp_path / name}")
    with pytest.raises(ConfigurationError, match="no such variable"):
        read_secret("env:NOBODY_SET_THIS")


SLIPS = [
    "password_from=HUNTER22",
    "password_from=env:HUNTER22",
    "password_from=file:HUNTER22",
    "password_from=keyring:cell/HUNTER22",
    "password_from=file:/HUNTER22/none,user=HUNTER22",
    "passwort=HUNTER22",
    "pass:HUNTER22",
    "auth=HUNTER22",
    "pin=HUNTER22",
    "credentials=HUNTER22",
    "HUNTER22",
    "contraseña=HUNTER22",
    "user=HUNTER22",
    "folder=HUNTER22",
    "topic=HUNTER22",
    "mqtt=HUNTER22",
    "mqtt=HUNTER22:1883",
    "mqtt_user=HUNTER22,mqtt=127.0.0.1:9",
    "ftp=HUNTER22",
    "mode=HUNTER22",
    "start=HUNTER22",
    " HUNTER22 = HUNTER22",
    "user=joe;auth=HUNTER22",
]


@pytest.mark.parametrize("driver", available())
@pytest.mark.parametrize("joint", [",", "?", ";", " ", "&", "#", "/", "|", ":", ",,"])
def test_address_options_are_not_printed(driver: str, joint: str):
    """The text after the address of a password is never repeated, whatever its name."""
    for address in (f"{place}{joint}{slip}" for place in ("127.0.0.1:9", "127.0.0.1", "localhost:9") for slip in SLIPS):
        with pytest.raises(DriverError) as said, closing(create(driver, address, timeout=0.2)) as controller:
            controller.connect()
        assert "HUNTER22" not in str(said.value)


@pytest.mark.parametrize("slip", SLIPS)
@pytest.mark.parametrize("key", ["address", "adress", "driver", "options"])
def test_address_options_of_a_recipe_are_not_printed(tmp_path: Path, slip: str, key: str):
    text = recipe("127.0.0.1", "cnr_comau").replace(
        'address: "127.0.0.1"', f'address: "127.0.0.1", {key}: "127.0.0.1,{slip}"'
    )
    if key in ("address", "driver"):
        text = text.replace('address: "127.0.0.1", address', "address").replace(
            "driver: cnr_comau, ", "", key == "driver"
        )
    (tmp_path / "recipe.yaml").write_text(text, encoding="utf-8")
    with pytest.raises((InputError, DriverError)) as said, answering(load_recipe(tmp_path / "recipe.yaml")):
        pass
    assert "HUNTER22" not in str(said.value)


@given(st.text(st.sampled_from("ab1.:/@,;?=&# [%]é"), max_size=12), st.sampled_from(",;?#& @="))
def test_a_password_is_looked_up_without_address_options(before: str, joint: str):
    shown = public_address(f"{before}{joint}hunter22")
    assert "hunter22" not in shown
    assert not shown.removesuffix(",…") or f"{before}{joint}".startswith(shown.removesuffix(",…"))


@pytest.mark.parametrize(
    "address",
    ["192.168.0.10:9100", "[fe80::1%eth0]:502", "robot-1.cell.example:9100", "/dev/ttyUSB0", "COM3", "loop://", "lpc",
     "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0", "socket://127.0.0.1:4000", r"\\.\COM10"],
)  # fmt: skip
def test_prints_a_plain_address_in_full(address: str):
    assert public_address(address) == address
    assert public_address(f"{address},115200") == f"{address},…"


def test_user_and_folder_echoed_by_a_server_are_not_printed(ftp_folder):
    refusing = ftp_folder()
    folder = ProgramFolder(replace(refusing._address, folder="HUNTER22"), 5.0)
    with pytest.raises(DriverError, match="no folder") as refusal:
        folder.stored()
    assert "HUNTER22" not in str(refusal.value)


@given(
    secret=st.text(st.characters(categories=("L", "N", "P", "S"), exclude_characters="*"), min_size=4, max_size=30),
    around=st.text(max_size=20),
)
def test_a_secret_appears_in_no_text_and_no_file(tmp_path_factory, secret: str, around: str):
    from html import escape
    from json import dumps

    os.environ["PLANTED_HERE"] = secret
    try:
        read_secret("env:PLANTED_HERE")
        text = f"{around}{secret}{around} {dumps(secret)} {escape(secret)} {secret!r}"
        for shown in (hide(text), hide_all(text), str(DriverError(text))):
            assert secret not in shown.replace("***", "\0")
        path = write_atomically(tmp_path_factory.getbasetemp() / "text.txt", text)
        assert secret not in path.read_text(encoding="utf-8").replace("***", "\0")
    finally:
        del os.environ["PLANTED_HERE"]
        hidden_forms.clear()


@contextmanager
def echoing_ftp_server() -> Iterator[int]:
    """A hostile one: its refusal repeats the password, between commands to the terminal, without end."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listening:

        def serve() -> None:
            connection, _ = listening.accept()
            with connection:
                connection.sendall(b"220 welcome\r\n")
                user = connection.recv(4096)
                connection.sendall(b"331 go on\r\n")
                password = connection.recv(4096).split(b" ", 1)[1].strip()
                connection.sendall(b"530 \x1b]0;owned\x07 no " + user.strip() + b" " + password + b"\r\n")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield listening.getsockname()[1]
        thread.join(5.0)


@pytest.mark.parametrize(
    "password", ["hunter22", "1234", "joe1", "no no", "%41%42", "a.*b+", "'; --", "<b>&", "zwölf", "530 530"]
)
def test_a_password_echoed_by_a_server_is_not_printed(monkeypatch: pytest.MonkeyPatch, password: str):
    monkeypatch.setenv("CELL_FTP", password)
    with echoing_ftp_server() as port:
        folder = ProgramFolder(parse_address(f"127.0.0.1,ftp={port},user=joe,password_from=env:CELL_FTP"), 5.0)
        with pytest.raises(DriverError, match="does not let this user in") as refusal:
            folder.stored()
    assert password not in str(refusal.value)
    assert "\x1b" not in str(refusal.value)


@pytest.mark.verify
@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_run_folders_contain_no_passwords(broker, tmp_path: Path, umask: int):
    """FTP and MQTT with passwords; all that the agent writes and says is searched, its files are as the umask says."""
    path = tmp_path / "mqtt.secret"
    path.write_text(f"mq-{PLANTED}", encoding="utf-8")
    path.chmod(0o600)
    work = tmp_path / "work"
    work.mkdir()
    controller = build_controller("comau_ns16", seed=7, clock="fast")
    with closing(CnrServer(controller, watchdog=20.0, broker=broker.address, waits=True)) as server:
        address = f"{server.address},password_from=env:CELL_FTP,mqtt_user=joe,mqtt_password_from=file:../mqtt.secret"
        (work / "recipe.yaml").write_text(recipe(address, "cnr_comau"), encoding="utf-8")
        command = [sys.executable, "-m", "agent", "calibrate", "recipe.yaml", "-v"]
        env = {**os.environ, "CELL_FTP": f"ftp-{PLANTED}", "PYTHONPATH": str(warm.ROOT)}
        run = subprocess.run(command, cwd=work, env=env, umask=umask, capture_output=True, text=True, check=False)
    assert list((work / "logs").glob("*/excitation.mcap")), run.stderr
    assert PLANTED not in run.stdout + run.stderr
    assert leaks(work, PLANTED) == []
    modes = {file.stat().st_mode & 0o777 & ~(0o666 & ~umask) for file in (work / "logs").rglob("*") if file.is_file()}
    assert modes == {0}, "no file is more open than the umask says"
