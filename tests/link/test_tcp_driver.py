"""The TCP driver against peers that are absent, silent, foreign or rude."""

import threading
from contextlib import closing

import pytest

from drivers.errors import ConfigurationError, DriverError, ProtocolError, RefusedError
from drivers.transports.tcp.driver import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import Refusal
from tests.conftest import free_port


@pytest.mark.parametrize("address", ["", "localhost", "host:", ":9100", "host:0", "host:70000", "host:x", "host:-1"])
def test_refuses_an_invalid_address_at_once(address):
    with pytest.raises(ConfigurationError, match="host:port is expected"):
        TcpDriver(address)


def test_reports_an_unreachable_controller():
    port = free_port()
    with pytest.raises(DriverError, match=rf"no controller answers at 127.0.0.1:{port}.*is it on"):
        TcpDriver(f"127.0.0.1:{port}").connect()


def test_reports_an_unknown_host():
    with pytest.raises(DriverError, match=r"host name 'no-such-host.invalid'"):
        TcpDriver("no-such-host.invalid:9100").connect()


def hangs_up(p):
    p.expect(tcp.Hello)


def speaks_http(p):
    p.expect(tcp.Hello)
    p.socket.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
    p.until_left()


def echoes(p):
    p.send(*p.receive())
    p.until_left()


def is_newer(p):
    _, request = p.expect(tcp.Hello)
    p.send(tcp.Welcome(2, 200), request)
    p.until_left()


@pytest.mark.parametrize(
    ("script", "error", "said"),
    [
        (lambda p: p.until_left(), DriverError, r"is silent.*did not answer the greeting within 0.1 s"),
        (hangs_up, DriverError, "closed the connection"),
        (speaks_http, ProtocolError, "not the calibration link"),
        (echoes, ProtocolError, "answered the greeting with Hello"),
        (is_newer, ProtocolError, "speaks version 2"),
    ],
    ids=["silent", "hangs_up", "speaks_http", "echoes", "is_newer"],
)
def test_reports_a_server_of_another_protocol(peer, script, error, said):
    timeout = 0.1 if "silent" in said else 5.0
    with pytest.raises(error, match=said):
        TcpDriver(peer(script), timeout=timeout).connect()


def test_nothing_works_before_connect_but_stop_and_close():
    driver = TcpDriver("127.0.0.1:1")
    for action in (driver.identify, driver.status, lambda: driver.upload("p", ""), lambda: driver.start("p", "")):
        with pytest.raises(DriverError, match="connect first"):
            action()
    with pytest.raises(DriverError, match="nothing was started"):
        driver.samples()
    driver.stop()
    driver.close()
    driver.close()


def test_the_controller_sets_the_watchdog_time(peer):
    with closing(TcpDriver(peer(lambda p: (p.welcome(1234), p.until_left())), watchdog=0.2)) as driver:
        driver.connect()
        assert driver.watchdog == 1.234


def test_heartbeats_continue_while_idle(peer):
    arrived = threading.Event()

    def listen(p):
        p.welcome(40)
        for _ in range(5):
            p.heartbeat()
        arrived.set()
        p.until_left()

    with closing(TcpDriver(peer(listen))) as driver:
        driver.connect()
        assert arrived.wait(20)


def test_a_link_carries_no_more_than_it_answers_in_time(peer):
    """Of the questions that measure it, ten are answered."""
    identity = tcp.IdentityReply("r", "s", "c", "v", ("one", "two"), 0.002)

    def answer_few(p):
        p.welcome()
        for number in range(257):
            _, request = p.expect(tcp.Identify)
            if number < 10 or number == 256:
                p.send(identity, request)
        p.until_left()

    sample = tcp.Samples.size(1, 2) - tcp.Samples.size(0, 2)
    with closing(TcpDriver(peer(answer_few), timeout=1.0)) as driver:
        driver.connect()
        assert 0 < driver.throughput() < 3 * 9 * len(tcp.encode(identity)) / sample


def test_a_refusal_carries_reason_and_position(peer):
    def refuse(p):
        p.welcome()
        _, request = p.expect(tcp.UploadBegin)
        p.send(tcp.Refused(Refusal.SYNTAX, 3, 7, "what is FOO?"), request)
        p.until_left()

    with closing(TcpDriver(peer(refuse))) as driver:
        driver.connect()
        with pytest.raises(RefusedError, match="the program p: syntax, line 3 column 7: what is FOO"):
            driver.upload("p", "FOO")
