"""Drivers by name, as a user and a third party meet them."""

import logging
import subprocess
import sys

import pytest

from drivers import registry
from drivers.errors import ConfigurationError
from drivers.transports.tcp.driver import TcpDriver
from tests.conftest import ROOT


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """`plug_in(name, source)` installs a distribution with one driver of that name."""

    def install(name: str, source: str) -> None:
        (tmp_path / f"plug_in_{name}.py").write_text(source, encoding="utf-8")
        info = tmp_path / f"plug_in_{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: plug-in-{name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{name} = plug_in_{name}:Plugged\n")
        monkeypatch.syspath_prepend(str(tmp_path))

    return install


def test_the_built_in_driver():
    driver = registry.create("tcp", "127.0.0.1:9100", watchdog=0.5)
    assert isinstance(driver, TcpDriver)
    assert driver.watchdog == 0.5


@pytest.mark.parametrize("name", ["telnet", "serial"])
def test_an_unknown_name_lists_what_there_is(name):
    with pytest.raises(ConfigurationError, match=f"no driver '{name}'; there are: cnr_comau, .*ros2, .*tcp, ur"):
        registry.create(name, "127.0.0.1:9100")


def test_drivers_are_loaded_on_demand():
    script = (
        "import sys, drivers.registry as r; r.available(); sys.exit('drivers.transports.tcp.driver' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", script], cwd=ROOT, check=False).returncode == 0


def test_a_third_party_driver(plug_in):
    plug_in("mine", "from drivers.transports.tcp.driver import TcpDriver\nclass Plugged(TcpDriver): pass\n")
    assert "mine" in registry.available()
    assert type(registry.create("mine", "127.0.0.1:9100")).__name__ == "Plugged"


def test_a_broken_plug_in_warns_and_is_left_out(plug_in, caplog):
    plug_in("broken", "raise RuntimeError('no such board')\n")
    with caplog.at_level(logging.WARNING), pytest.raises(ConfigurationError, match=r"no driver 'broken'.*tcp"):
        registry.create("broken", "127.0.0.1:9100")
    assert "no such board" in caplog.text
    registry.create("tcp", "127.0.0.1:9100")


def test_refuses_a_driver_without_a_required_method(plug_in):
    plug_in("half", "class Plugged:\n    def __init__(self, address): pass\n    def connect(self): pass\n")
    with pytest.raises(ConfigurationError, match="lacks a method"):
        registry.create("half", "127.0.0.1:9100")


def test_a_plug_in_cannot_replace_a_built_in_driver(plug_in):
    plug_in("tcp", "class Plugged: pass\n")
    assert isinstance(registry.create("tcp", "127.0.0.1:9100"), TcpDriver)
