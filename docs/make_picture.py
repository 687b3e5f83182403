"""Writes docs/diagnosis.svg: the first screen of a real diagnosis, drawn as a terminal.

`python docs/make_picture.py` calibrates an emulated robot, builds a hose into joint 4, diagnoses it with
`agent diagnose --record`, and draws what the command printed. It takes a few minutes.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from html import escape
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURE = Path(__file__).with_name("diagnosis.svg")
HOSE = {
    "effect": "dress_pack",
    "joints": ["joint_4"],
    "parameters": {"stiffness": 3.0, "centre": 0.3, "hysteresis": 1.5},
}
COLUMNS, INDENT, SEED = 100, 10, 7
CHARACTER, LINE, MARGIN = 7.8, 18, 16  # px


def main() -> None:
    """Write the picture."""
    with tempfile.TemporaryDirectory() as folder:
        PICTURE.write_text(drawn(screen_of(Path(folder))), encoding="utf-8")


def drawn(screen: str) -> str:
    """An SVG of a screen up to what to do next, wrapped as a terminal does."""
    head, _, after = screen.partition("\nNext")
    shown = f"{head}\nNext{after.partition(chr(10))[0]}".splitlines()
    lines = [
        (part, _emphasis(line))
        for line in shown
        for part in textwrap.wrap(line, COLUMNS, subsequent_indent=" " * INDENT)
    ]
    width, height = COLUMNS * CHARACTER + 2 * MARGIN, len(lines) * LINE + 2 * MARGIN
    rows = "\n".join(
        f'<text x="{MARGIN}" y="{MARGIN + (k + 0.75) * LINE:g}"{emphasis}>{_text(line)}</text>'
        for k, (line, emphasis) in enumerate(lines)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="Terminal output of agent diagnose">\n'
        f'<rect width="100%" height="100%" rx="8" fill="#14181d"/>\n'
        f'<g font-family="ui-monospace, Menlo, Consolas, monospace" font-size="13" fill="#d5dde5">\n'
        f"{rows}\n</g>\n</svg>\n"
    )


def _text(line: str) -> str:
    """With spaces that no viewer joins."""
    return escape(line).replace(" ", "\N{NO-BREAK SPACE}")


def _emphasis(line: str) -> str:
    return ' fill="#7ee0a0" font-weight="bold"' if line.startswith(("$", "Verdict", "What")) else ""


def screen_of(folder: Path, name: str = "first_look.yaml") -> str:
    """The command and what it printed; the runs of the recipe of this `name` stay in the folder."""
    recipe = folder / name
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    recipe.write_text((ROOT / "recipes" / name).read_text("utf-8").replace("9100", port), encoding="utf-8")
    effects = folder / "effects.json"
    effects.write_text(json.dumps([HOSE]), encoding="utf-8")
    with _emulator(folder, port):
        _agent(folder, "calibrate", recipe.name)
    (model,) = (folder / "logs/models").glob("*/current/model.json")
    with _emulator(folder, port, "--effects", str(effects)):
        screen = _agent(folder, "diagnose", "--record", recipe.name, "--model", str(model.relative_to(folder)))
    return f"$ agent diagnose --record {recipe.name} --model model.json\n{screen}"


def _agent(folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "agent", *arguments]
    run = subprocess.run(command, cwd=folder, env=_environment(), check=True, capture_output=True, text=True)
    return run.stdout


@contextlib.contextmanager
def _emulator(folder: Path, port: str, *more: str) -> Iterator[None]:
    ready = folder / "ready"
    ready.unlink(missing_ok=True)
    options = ["--port", port, "--seed", str(SEED), "--clock", "fast", "--ready-file", str(ready), *more]
    process = subprocess.Popen([sys.executable, "-m", "fake_controller", *options], cwd=folder, env=_environment())
    try:
        while not ready.exists():
            if process.poll() is not None:
                raise RuntimeError("the emulator did not start")
            time.sleep(0.2)
        yield
    finally:
        process.terminate()
        process.wait()


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS), "NO_COLOR": "1"}


if __name__ == "__main__":
    main()
