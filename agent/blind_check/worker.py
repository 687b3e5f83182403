"""The diagnosing process: `python -m agent.blind_check.worker`, a job a line on stdin, an answer a line on stdout.

A job names the folder of one run, and effects to leave out of the catalogue. The folder is all the process gets.
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def main() -> int:
    """Answer jobs until stdin ends."""
    for line in sys.stdin:
        job = json.loads(line)
        print(json.dumps(_answered(Path(job["folder"]), job["without"])), flush=True)
    return 0


def _answered(folder: Path, without: Sequence[str]) -> dict[str, Any]:
    """The diagnosis, or why there is none."""
    from agent.core import AgentError, finite

    try:
        result = diagnose_run(folder, without)
    except AgentError as error:
        return {"error": str(error)}
    except Exception as error:  # one run that breaks the diagnosis is a result, not the end of the check
        traceback.print_exc()
        return {"error": f"internal error in the diagnosis: {type(error).__name__}: {error}"}
    return finite({"result": result})


def diagnose_run(folder: Path, without: Sequence[str] = ()) -> dict[str, Any]:
    """Fit a model to the baseline of a run, and diagnose its logs against it; a run without torque, against its file.

    Raises:
        InputError: as in `diagnose` and `estimate`.
    """
    from agent.diagnosis import diagnose, with_healthy_effects
    from agent.estimation import estimate
    from agent.recording import read_log, read_recording
    from agent.robot import load_robot
    from agent.simulators import load_arm, load_simulator

    if (file := folder / "arm.xml").exists():
        arm, recorded = load_arm(file), folder / "logs"
        parts = sorted(recorded.glob("*.csv")) or [recorded]
        logs = [log for part in parts for log in read_recording(part, arm)[0]]
        simulator = load_simulator(file, None, arm.joint_names)
        return diagnose(simulator.model.robot, logs, simulator.model, simulator=simulator, without=without).result
    robot = load_robot(folder / "robot.yaml")
    baseline, logs = (
        [read_log(log, robot) for log in sorted((folder / session).glob("*.mcap"))] for session in ("baseline", "logs")
    )
    model = with_healthy_effects(estimate(robot, baseline), baseline)
    return diagnose(robot, logs, model, without=without).result


if __name__ == "__main__":
    sys.exit(main())
