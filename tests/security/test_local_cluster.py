"""The processes that a fleet starts on this machine do what their user asks for, and nobody else."""

import os

import distributed
import pytest
from distributed.security import Security

from agent.core.on_dask import DaskEngine


@pytest.fixture(scope="module")
def engine():
    with DaskEngine(workers=1) as engine:
        yield engine


def _places(engine) -> list[str]:
    workers = engine._client.scheduler_info()["workers"]
    return [engine._cluster.scheduler_address, *workers, *(one["nanny"] for one in workers.values())]


def test_every_process_requires_a_certificate(engine):
    assert [place for place in _places(engine) if not place.startswith("tls://")] == []
    assert [done.answer for done in engine.map(os.getenv, ["HOME"])] == [os.environ["HOME"]]


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
@pytest.mark.parametrize("which", [0, 1, 2], ids=["scheduler", "worker", "nanny"])
def test_another_user_cannot_run_code(engine, protocol: str, which: int):
    """Without a certificate, and with one of their own."""
    place = _places(engine)[which].replace("tls://", f"{protocol}://")
    theirs = Security.temporary() if protocol == "tls" else None
    with pytest.raises((OSError, TimeoutError)):
        distributed.Client(place, security=theirs, timeout=2, set_as_default=False).run(os.getuid)


@pytest.mark.parametrize(("place", "warned"), [("tcp://127.0.0.1:9", 1), ("127.0.0.1:9", 1), ("tls://127.0.0.1:9", 0)])
def test_warns_of_a_scheduler_without_tls(monkeypatch, place: str, warned: int):
    said = []
    engine = DaskEngine(place, warn=said.append)
    monkeypatch.setattr(distributed, "Client", lambda *_, **__: None)
    with engine:
        assert len(said) == warned
        assert all("tls://" in text for text in said)
