"""What a person sees while the agent works: messages on stderr, results on stdout."""

from __future__ import annotations

import atexit
import json
import os
import re
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core.output import flush_results, patient, without_secrets
from drivers.texts import hide, printable

if TYPE_CHECKING:
    from rich.console import Console as RichConsole
    from rich.progress import Progress

#: Characters of one message; a recipe with many faults has some thousands.
LONGEST = 20_000
_LONGEST_RESULT = 10_000_000
#: What the agent's own lines begin with, after a line feed.
_OWN_LINE = re.compile(r"\n\s*(?=agent: |warning: |\[ *\d+\.?\d* s\])")
_SOON = 2.0  # s of a stage: its first step may compile, and says little of the time left
_FRAME = 0.1  # s, between two pictures of the progress on a terminal
_BAR = 20  # characters


class Console:
    """Progress and messages. Nobody who sends one waits for a reader (see `agent.core.output`).

    On a terminal a running step has a line with a bar below the messages, gone at its end; elsewhere it prints a line
    at most every `interval` seconds, so a log file stays readable and a waiting person still sees that something moves.

    Args:
        verbosity: -1 quiet (warnings and results only), 0 normal, 1 verbose.
    """

    def __init__(self, verbosity: int = 0, interval: float = 5.0, clock: Callable[[], float] = time.monotonic):
        import rich.progress  # noqa: F401  not in the midst of a motion
        from rich.console import Console as RichConsole

        self.verbosity = verbosity
        self._interval = interval
        self._clock = clock
        self._rich = RichConsole(file=_Messages(), highlight=False, soft_wrap=True)  # type: ignore[arg-type]
        self._begin = clock()
        self._last = -float("inf")
        self._stage = self._begin

    def step(self, title: str) -> None:
        """Begin a stage."""
        end_progress()
        self._last = -float("inf")
        self._stage = self._clock()
        self.say(title)

    def progress(self, text: str, done: float | None = None) -> None:
        """Show how far the running stage has come, at most every `interval` seconds off a terminal.

        With `done`, from 0 to 1, the time left is shown after two seconds of the stage.
        """
        if self.verbosity < 0:
            return
        now, terminal = self._clock(), self._rich.is_interactive
        if now - self._last < (_FRAME if terminal else self._interval):
            return
        if terminal and getattr(patient(sys.stderr), "behind", False):
            return
        self._last, spent = now, now - self._stage
        if done and done < 1 and spent > _SOON:
            text += f", about {max(1.0, spent * (1 - done) / done):.0f} s left"
        if terminal:
            _picture(self._rich, f"{self._stamp()}   {fit_to_show(text)}", done)
        else:
            self._print(f"  {text}")

    def say(self, text: str) -> None:
        """A message; left out with -q."""
        if self.verbosity >= 0:
            self._print(text)

    def detail(self, text: str) -> None:
        """A message for -v."""
        if self.verbosity > 0:
            self._print(f"  {text}")

    def warn(self, text: str) -> None:
        """Something the user should know; always shown."""
        self._print(f"warning: {text}", style="yellow")

    def confirm(self, question: str) -> bool:
        """Ask a person; without a terminal the answer is no."""
        if not (sys.stdin.isatty() and patient(sys.stderr).isatty()):
            return False
        end_progress()
        self._rich.print(f"{fit_to_show(question)} [y/N] ", end="", markup=False)
        patient(sys.stderr).drain()
        return sys.stdin.readline().strip().lower() in ("y", "yes")

    def _print(self, text: str, style: str = "") -> None:
        from rich.text import Text

        self._rich.print(Text(f"{self._stamp()} {fit_to_show(text)}", style))

    def _stamp(self) -> str:
        return f"[{self._clock() - self._begin:6.1f} s]"


class _Messages:
    """The current `sys.stderr`, which may be replaced at any time."""

    def __getattr__(self, name: str) -> Any:
        return getattr(patient(sys.stderr), name)


_shown: Progress | None = None


def _picture(rich: RichConsole, text: str, done: float | None) -> None:
    """Draw the progress of the stage anew."""
    global _shown
    from rich.progress import BarColumn, Progress, TaskID, TextColumn
    from rich.table import Column

    if _shown is None:
        columns = (TextColumn("{task.description}", markup=False, table_column=Column()), BarColumn(_BAR))
        _shown = Progress(
            *columns, console=rich, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False
        )
        _shown.add_task(text, total=None)
        atexit.register(end_progress)
        _shown.start()
    _shown.update(TaskID(0), description=text, completed=done or 0.0, total=1.0 if done else None, refresh=True)


def end_progress() -> None:
    """Take the progress of a stage off the terminal: something else is to be shown, or the program ends."""
    global _shown
    progress, _shown = _shown, None
    if progress is not None:
        progress.stop()
        atexit.unregister(end_progress)


def print_text(text: str) -> None:
    """A result for people on stdout."""
    end_progress()
    flush_results(printable(hide(text), _LONGEST_RESULT, lines=True) + "\n")


def print_path(path: Path) -> None:
    """A result's path on stdout; on a terminal it is a link that can be clicked (OSC 8)."""
    end_progress()
    text = fit_to_show(str(path))
    if sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb":
        text = f"\033]8;;{path.resolve().as_uri()}\033\\{text}\033]8;;\033\\"
    flush_results(f"{text}\n")


def print_json(data: Any) -> None:
    """One JSON object on stdout; a number that is not finite becomes null."""
    end_progress()
    flush_results(hide(json.dumps(finite(data), indent=2)) + "\n")


def fit_to_show(text: str) -> str:
    """A message for a terminal, cut to `LONGEST` characters: without passwords, control characters and lines that
    imitate the agent's own. Names of folders and joints in it come from others."""
    return _OWN_LINE.sub(" ", without_secrets(text, LONGEST, lines=True))


def finite(data: Any) -> Any:
    """The same data as plain JSON types: arrays as lists, NaN and infinity as None."""
    import numpy as np

    if isinstance(data, dict):
        return {str(key): finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [finite(value) for value in data]
    if isinstance(data, np.ndarray):
        return finite(data.tolist())
    if isinstance(data, np.generic):
        return finite(data.item())
    if isinstance(data, float) and not np.isfinite(data):
        return None
    return data
