"""The entry point: one message and one exit code for every end."""

from __future__ import annotations

import gc
import os
import sys
import warnings

import typer

from agent.cli.app import app
from agent.core import (
    FULL_OR_READ_ONLY,
    AgentError,
    Ended,
    end_progress,
    fit_to_show,
    flush_results,
    hang_up,
    open_standard_descriptors,
    patient_messages,
    signals_raised,
)

_INTERRUPTED = 130
#: New objects between two looks for garbage: modules that are imported make many, and none of it.
_COLLECT_EVERY = 100_000


def main() -> None:
    """Entry point: runs the command and turns every error into one message and its exit code."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # With colours numba writes to the terminal as the program ends, and waits for one that is frozen.
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    if not sys.warnoptions:  # a library's warning about numbers names no file; `python -W` shows them
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"  # of processes that this one starts
    gc.set_threshold(_COLLECT_EVERY)
    open_standard_descriptors()
    with signals_raised(), patient_messages(hang_up):
        _run()


def _run() -> None:
    try:
        code = _called()
        if code == _INTERRUPTED:  # typer's word for a KeyboardInterrupt
            raise KeyboardInterrupt
        flush_results()
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", _INTERRUPTED)
    except (Ended, AgentError) as error:
        _fail(str(error), error.exit_code)
    except Exception as error:
        _unexpected(error)
    sys.exit(code if isinstance(code, int) else 0)


def _called() -> object:
    """Run the command; recover a signal that compiled code has turned into a SystemError."""
    try:
        return app(standalone_mode=False)
    except SystemExit as end:
        if not isinstance(end.__context__, BrokenPipeError):  # a reader of help that is gone wanted no more
            raise
        return 0
    except SystemError as error:
        if isinstance(error.__cause__, KeyboardInterrupt | Ended):
            raise error.__cause__ from None
        raise


def _unexpected(error: Exception) -> None:
    code = getattr(error, "exit_code", None)
    if isinstance(code, int):  # the errors of click and of the drivers
        if show := getattr(error, "show", None):
            show()
            sys.exit(code)
        _fail(str(error), code)
    if isinstance(error, OSError) and (error.filename is not None or error.errno in FULL_OR_READ_ONLY):
        subject = error.filename or "the result cannot be written"
        _fail(f"{subject}: {error.strerror}; free space or rights? Otherwise choose another folder", 1)
    import traceback

    traceback.print_exc()
    _fail("internal error: a fault of the agent, or of a driver or effect added to it; the lines above say where", 1)


def _fail(message: str, code: int) -> None:
    end_progress()
    print(f"agent: {fit_to_show(message)}", file=sys.stderr)
    sys.exit(code)
