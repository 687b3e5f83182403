"""The process `agent`: a signal that comes while the command line is still loaded ends it with one line, too."""

import os
import signal
from types import FrameType


def main() -> None:
    """Entry point. Once it is loaded, the command line turns signals into exceptions (`agent.core.signals`)."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end)
    from agent.cli import main as run_command

    run_command()


def _end(number: int, _: FrameType | None) -> None:
    try:
        os.write(2, b"agent: interrupted\n" if number == signal.SIGINT else b"agent: terminated\n")
    finally:
        os._exit(128 + number)


if __name__ == "__main__":
    main()
