"""`make calibrate`: the fake controller as a process of its own, and the quickstart recipe; runs go to `logs`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ADDRESS = "127.0.0.1:9100"


def main() -> int:
    """Exit code of the calibration; 4 where the fake controller did not come up."""
    host, port = ADDRESS.split(":")
    options = ["--robot", "comau_ns16", "--address", host, "--port", port, "--seed", "7", "--clock", "fast"]
    controller = subprocess.Popen(
        [sys.executable, "-m", "fake_controller", *options], stdout=subprocess.PIPE, text=True
    )
    try:
        ready = controller.stdout.readline() if controller.stdout else ""
        if not ready:
            print(f"the fake controller did not start; is another program using port {port}?", file=sys.stderr)
            return 4
        print(ready, end="", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "agent", "calibrate", str(HERE / "ns16_quickstart.yaml")]
        return subprocess.call(command)
    except KeyboardInterrupt:
        return 130
    finally:
        controller.terminate()
        controller.wait(timeout=10)


if __name__ == "__main__":
    sys.exit(main())
