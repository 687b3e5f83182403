"""The suite that every driver has to pass, run on the drivers there are; over real sockets."""

import contextlib
import socket
import threading

import numpy as np
import pytest

from drivers.conformance import DriverConformance
from drivers.registry import create
from drivers.transports.modbus import driver as modbus_driver
from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer
from fake_controller.servers.modbus.server import ModbusServer
from fake_controller.servers.tcp import TcpServer
from tests.conftest import free_port, patience
from tests.link.conftest import LONG, SHORT, Relay


class LinkRelay(Relay):
    """Can be made silent, and say once more what the driver said since it opened the link."""

    def __init__(self, target):
        self.silent = self.swallowing = False
        self._said = []
        self._answered = threading.Event()
        super().__init__(target, self._pass)

    def opened(self):
        self._said.clear()

    def replay(self):
        self.swallowing = True
        for data in list(self._said):
            self._answered.clear()
            self.sockets[-1].sendall(data)
            self._answered.wait(0.05)
        self.swallowing = False

    def _pass(self, outward, data):
        if outward:
            self._said.append(data)
            return data
        self._answered.set()
        return b"" if self.silent or self.swallowing else data


class SocketBench:
    """What the benches of all wires share."""

    joint_names = ("shoulder", "elbow")
    short, long, comment, set_points = SHORT, LONG, "--", True
    name: str

    def __init__(self, arm, undo):
        self.controller = build_controller(arm, seed=3, clock="fast")
        self.undo = undo
        self.wire = self.connect_wire()

    def driver(self):
        return self.created(self.address, watchdog=patience(2.0), timeout=patience(2.0))

    def created(self, address, **options):
        driver = create(self.name, address, **options)
        self.undo.callback(driver.close)
        return driver

    def motions_started(self):
        return self.controller.motions_started

    def moving(self):
        return self.controller.moving

    def cut(self):
        self.wire.close()

    def silence(self):
        self.wire.silent = True

    def replay(self):
        self.wire.replay()

    def connect_wire(self):
        server = self.serve()
        self.undo.callback(server.close)
        relay = LinkRelay(("127.0.0.1", server.port))
        self.undo.callback(relay.close)
        self.address = relay.address
        return relay

    def nobody(self):
        return self.created(f"127.0.0.1:{free_port()}")

    def mute(self):
        return self._answering(b"")

    def stranger(self):
        return self._answering(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")

    def _answering(self, answer, greeting=b""):
        listener = socket.create_server(("127.0.0.1", 0))
        self.undo.callback(listener.close)

        def serve():
            with contextlib.suppress(OSError):
                client, _ = listener.accept()
                with client:
                    client.sendall(greeting)
                    while client.recv(65536):
                        client.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        return self.created(f"127.0.0.1:{listener.getsockname()[1]}", timeout=patience(0.5))


class TcpBench(SocketBench):
    name = "tcp"

    def serve(self):
        return TcpServer(self.controller)


class ModbusBench(SocketBench):
    name = "modbus"

    def serve(self):
        return ModbusServer(self.controller, memory=2000, waits=True)


class Relays:
    """One in front of each port; the trajectory's is the first."""

    def __init__(self, targets):
        self.all = [LinkRelay(target) for target in targets]
        self.ports = [relay.address.rpartition(":")[2] for relay in self.all]

    @property
    def silent(self):
        return self.all[0].silent

    @silent.setter
    def silent(self, value):
        for relay in self.all:
            relay.silent = value

    def close(self):
        for relay in self.all:
            relay.close()

    def replay(self):
        self.all[0].replay()


class CnrBench(SocketBench):
    name = "cnr_comau"

    def __init__(self, arm, undo, broker):
        self.broker = broker
        super().__init__(arm, undo)

    def connect_wire(self):
        server = CnrServer(self.controller, watchdog=patience(2.0), broker=self.broker.address, waits=True)
        self.undo.callback(server.close)
        relays = Relays([*(("127.0.0.1", port) for port in server.ports), self.broker.address])
        self.undo.callback(relays.close)
        self.address = self.at(*relays.ports)
        return relays

    def at(self, trajectory, feedback, status, ftp, mqtt):
        ports = f"trajectory={trajectory},feedback={feedback},status={status},ftp={ftp}"
        return f"127.0.0.1,{ports},mqtt=127.0.0.1:{mqtt}"

    def driver(self):
        driver = self.created(self.address)
        driver.torque_per_ampere = np.diag([50.0, -32.0])  # gear ratio times torque constant
        return driver

    def created(self, address, **options):
        _, _, port = address.rpartition(":")
        return super().created(address if "," in address else self.at(*[port] * 5), **options)


@pytest.fixture
def bench(request, arm, monkeypatch):
    # as the benches' own watchdogs: a machine with other work answers a heartbeat later
    monkeypatch.setattr(modbus_driver, "WATCHDOG", patience(modbus_driver.WATCHDOG))
    with contextlib.ExitStack() as undo:
        needs = [request.getfixturevalue("broker")] if request.cls.bench is CnrBench else []
        yield request.cls.bench(arm, undo, *needs)


class TestTcp(DriverConformance):
    bench = TcpBench


class TestModbus(DriverConformance):
    bench = ModbusBench


class TestCnrComau(DriverConformance):
    bench = CnrBench
