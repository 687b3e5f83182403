"""Small fleets, the command line in this process, and real parts: a Dask cluster, an S3 server."""

import http.client
import http.server
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from agent.core.console import Console
from tests.conftest import end_with_tests, environment, free_port

pytest.importorskip("distributed", reason="needs the extra [fleet]")


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """`command(*arguments)` runs the agent here, tasks one after the other; its JSON where `--json` is among them."""
    from agent import core

    # what the command line imports: the package keeps what it has loaded once, so the module is not asked again
    monkeypatch.setattr(core, "DaskEngine", lambda *_: core.InProcess())

    def run(*arguments: object) -> Any:
        capsys.readouterr()
        code = _agent()([str(each) for each in arguments], standalone_mode=False)
        assert not code, capsys.readouterr().err
        out = capsys.readouterr().out
        return json.loads(out) if "--json" in arguments else out

    return run


@cache
def _agent() -> Any:
    """The command line; typer takes 0.2 s to build it."""
    from typer.main import get_command

    from agent.cli.app import app

    return get_command(app)


def rows_of(folder: Path | str) -> list[dict[str, Any]]:
    """The rows of a result, as plain data."""
    import pyarrow.parquet as pq

    return pq.read_table(folder).to_pylist()


def estimate(source: Path | str, out: Path | str, console: Console | None = None) -> Any:
    """`agent fleet estimate`, tasks one after the other; returns its summary."""
    from agent.core.parallel import InProcess
    from agent.fleet import make_question, run_fleet

    question = make_question("estimate", None, None)
    return run_fleet(str(source), question, str(out), lambda _: InProcess(), console or Console(-1))


@pytest.fixture(scope="session")
def plant(arm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four machines with two runs each, not to be changed; and a log of nonsense."""
    from agent.fleet.simulate import simulate_fleet

    folder = tmp_path_factory.mktemp("fleet") / "plant"
    simulate_fleet(arm, 4, 2, 1, str(folder), rows=False)
    (folder / "robot_0003" / "bad").mkdir()
    (folder / "robot_0003" / "bad" / "a.mcap").write_text("nonsense", encoding="utf-8")
    return folder


def a_run_each(plant: Path, folder: Path) -> Path:
    """A copy of machines with their first run alone, their times of change kept; what is no log is copied too."""
    shutil.copytree(plant, folder)
    for robot in folder.glob("robot_*"):
        runs = sorted(path for path in robot.iterdir() if path.is_dir() and path.name != "bad")
        for run in runs[1:]:
            shutil.rmtree(run)
    return folder


@pytest.fixture(scope="session")
def estimated(plant: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its result, made undisturbed by one process."""
    out = tmp_path_factory.mktemp("result")
    estimate(plant, out)
    return out


class DaskProcesses:
    """A scheduler and two workers as processes, as a cluster has them; whoever supervises it starts them again."""

    def __init__(self) -> None:
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.supervise()

    def supervise(self) -> None:
        """Start what does not run."""
        scheduler = [f"--host={self.address}", "--no-dashboard", "--no-show"]
        worker = [self.address, "--nthreads=1", "--no-dashboard", "--no-nanny"]
        wanted = {"scheduler": scheduler, "worker 1": worker, "worker 2": worker}
        for name, options in wanted.items():
            if name not in self.running or self.running[name].poll() is not None:
                command = [sys.executable, "-m", f"distributed.cli.dask_{name.split()[0]}", *options]
                self.running[name] = subprocess.Popen(
                    command,
                    env=environment(),
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    preexec_fn=end_with_tests,
                )

    def kill(self, name: str) -> None:
        """-9."""
        self.running[name].kill()
        self.running[name].wait()

    def close(self) -> None:
        """End all."""
        for process in self.running.values():
            process.kill()
            process.wait()


@pytest.fixture
def cluster() -> Iterator[DaskProcesses]:
    """A cluster that ends with the test."""
    processes = DaskProcesses()
    yield processes
    processes.close()


class FlakyProxy:
    """Stands before an S3 server; requests for which `fault(number, method, path)` says so fail: "500", or "cut" in the
    middle of the answer."""

    def __init__(self, port: int) -> None:
        proxy = self
        self.fault: Callable[[int, str, str], str] = lambda number, method, path: ""
        self.count = 0
        self.faults = 0

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _pass_on(self) -> None:
                proxy.count += 1
                fault = proxy.fault(proxy.count, self.command, self.path)
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                if fault == "500":
                    proxy.faults += 1
                    self.send_response(500)
                    self.send_header("Content-Length", "0")
                    self.end_headers()
                    return
                server = http.client.HTTPConnection("127.0.0.1", port)
                server.request(self.command, self.path, body, dict(self.headers))
                answer = server.getresponse()
                content = answer.read()
                self.send_response(answer.status)
                for key, value in answer.getheaders():
                    if key.lower() not in ("transfer-encoding", "connection", "content-length"):
                        self.send_header(key, value)
                length = answer.getheader("Content-Length") if self.command == "HEAD" else len(content)
                self.send_header("Content-Length", str(length or 0))
                self.end_headers()
                if fault == "cut" and len(content) > 1000:
                    proxy.faults += 1
                    self.wfile.write(content[: len(content) // 2])
                    self.close_connection = True
                    return
                self.wfile.write(content)
                server.close()

            do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _pass_on

            def log_message(self, *_: object) -> None:
                return

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def s3(monkeypatch: pytest.MonkeyPatch) -> Iterator[FlakyProxy]:
    """An S3 server with a bucket `plant`, behind a proxy that can be made to fail."""
    from moto.server import ThreadedMotoServer

    for key, value in {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "DEFAULT_REGION": "us-east-1"}.items():
        monkeypatch.setenv(f"AWS_{key}", value)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    port = server.get_host_and_port()[1]
    reset = http.client.HTTPConnection("127.0.0.1", port)  # what it holds outlives a server
    reset.request("POST", "/moto-api/reset")
    reset.getresponse().read()
    proxy = FlakyProxy(port)
    monkeypatch.setenv("AWS_ENDPOINT_URL", proxy.url)
    import s3fs

    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")  # tries of the libraries below have pauses of their own
    monkeypatch.setattr(s3fs.S3FileSystem, "retries", 1)
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("plant")
    yield proxy
    s3fs.S3FileSystem.clear_instance_cache()
    proxy.close()
    server.stop()
