"""The suite that every driver has to pass, run on the drivers there are; over real sockets."""

import contextlib

import numpy as np
import pytest

from drivers.bench import SocketBench, WireRelays
from drivers.conformance import DriverConformance
from drivers.transports.modbus import driver as modbus_driver
from fake_controller.build import build_controller
from fake_controller.servers.cnr.server import CnrServer
from fake_controller.servers.modbus.server import ModbusServer
from fake_controller.servers.tcp import TcpServer
from tests.conftest import patience
from tests.link.conftest import LONG, SHORT


class EmulatedBench(SocketBench):
    """What the benches of emulated wires share."""

    joint_names = ("shoulder", "elbow")
    short, long, comment, set_points = SHORT, LONG, "--", True
    wait = staticmethod(patience)

    def __init__(self, arm, undo):
        self.controller = build_controller(arm, seed=3, clock="fast")
        super().__init__(undo)

    def listening(self):
        server = self.serve()
        self.undo.callback(server.close)
        return "127.0.0.1", server.port

    def motions_started(self):
        return self.controller.motions_started

    def moving(self):
        return self.controller.moving


class TcpBench(EmulatedBench):
    name = "tcp"

    def serve(self):
        return TcpServer(self.controller)


class ModbusBench(EmulatedBench):
    name = "modbus"

    def serve(self):
        return ModbusServer(self.controller, memory=2000, waits=True)


class CnrBench(EmulatedBench):
    name = "cnr_comau"

    def __init__(self, arm, undo, broker):
        self.broker = broker
        super().__init__(arm, undo)

    def connect_wire(self):
        server = CnrServer(self.controller, watchdog=patience(2.0), broker=self.broker.address, waits=True)
        self.undo.callback(server.close)
        relays = WireRelays([*(("127.0.0.1", port) for port in server.ports), self.broker.address])
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
