"""The TCP driver against peers that are absent, silent, foreign or rude."""

import threading
from contextlib import closing

import pytest

from drivers.errors import ConfigurationError, DriverError, ProtocolError, RefusedError
from drivers.protocol import Driver
from drivers.transports.tcp import TcpDriver
from drivers.wire import tcp
from drivers.wire.reasons import Refusal
from tests.conftest import free_port


def test_it_is_a_driver():
    assert isinstance(TcpDriver("127.0.0.1:9100"), Driver)


@pytest.mark.parametrize("address", ["", "localhost", "host:", ":9100", "host:0", "host:70000", "host:x", "host:-1"])
def test_what_is_no_address_is_refused_at_once(address):
    with pytest.raises(ConfigurationError, match="host:port is expected"):
        TcpDriver(address)


def test_nobody_there():
    port = free_port()
    with pytest.raises(DriverError, match=rf"no controller answers at 127.0.0.1:{port}.*is it on"):
        TcpDriver(f"127.0.0.1:{port}").connect()


def test_unknown_host():
    with pytest.raises(DriverError, match=r"host name 'no-such-host.invalid'"):
        TcpDriver("no-such-host.invalid:9100").connect()


def test_a_silent_peer(peer):
    driver = TcpDriver(peer(lambda p: p.until_left()), timeout=0.1)
    with pytest.raises(DriverError, match=r"is silent.*did not answer the greeting within 0.1 s"):
        driver.connect()


def test_a_peer_that_hangs_up(peer):
    with pytest.raises(DriverError, match=r"closed the connection"):
        TcpDriver(peer(lambda p: p.expect(tcp.Hello))).connect()


def test_another_protocol(peer):
    def http(p):
        p.expect(tcp.Hello)
        p.socket.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        p.until_left()

    with pytest.raises(ProtocolError, match="not the calibration link"):
        TcpDriver(peer(http)).connect()


def test_an_echo_is_not_a_controller(peer):
    def echo(p):
        message, request = p.receive()
        p.send(message, request)
        p.until_left()

    with pytest.raises(ProtocolError, match="answered the greeting with Hello"):
        TcpDriver(peer(echo)).connect()


def test_another_version_of_the_link(peer):
    def newer(p):
        _, request = p.expect(tcp.Hello)
        p.send(tcp.Welcome(2, 200), request)
        p.until_left()

    with pytest.raises(ProtocolError, match="speaks version 2"):
        TcpDriver(peer(newer)).connect()


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


def test_the_controller_has_the_last_word_on_the_watchdog(peer):
    with closing(TcpDriver(peer(lambda p: (p.welcome(1234), p.until_left())), watchdog=0.2)) as driver:
        driver.connect()
        assert driver.watchdog == 1.234


def test_heartbeats_go_out_while_nobody_does_anything(peer):
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


def test_a_refusal_carries_reason_and_place(peer):
    def refuse(p):
        p.welcome()
        _, request = p.expect(tcp.UploadBegin)
        p.send(tcp.Refused(Refusal.SYNTAX, 3, 7, "what is FOO?"), request)
        p.until_left()

    with closing(TcpDriver(peer(refuse))) as driver:
        driver.connect()
        with pytest.raises(RefusedError, match="the program p: syntax, line 3 column 7: what is FOO"):
            driver.upload("p", "FOO")
