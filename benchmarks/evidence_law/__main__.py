"""`python -m benchmarks.evidence_law RUNS -o ANSWERS.jsonl`: RUNS is the folder of `agent blind-check --export`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from agent.core.errors import AgentError
from agent.diagnosis.candidate import Where
from agent.diagnosis.dataset import assemble
from agent.estimation import EstimationSettings, estimate
from agent.recording import read_log
from agent.robot import RobotDescription, load_robot
from benchmarks.evidence_law.healthy import on, usual_effects
from benchmarks.evidence_law.search import Search


def main() -> None:
    """Answer every run that has no answer yet."""
    parser = argparse.ArgumentParser(description="answers by log evidence to the runs of a blind check")
    parser.add_argument("runs", type=Path, help="folder of the export")
    parser.add_argument("-o", "--out", type=Path, required=True, help="answers to write, gone on with")
    parser.add_argument("--without", nargs="*", default=(), help="effects left out of the catalogue")
    asked = parser.parse_args()
    known = asked.out.read_text(encoding="utf-8").splitlines() if asked.out.exists() else []
    done = {json.loads(line)["run"] for line in known}
    with open(asked.out, "a", encoding="utf-8") as out:
        for folder in sorted((asked.runs / "runs").iterdir()):
            if folder.name in done:
                continue
            try:
                out.write(json.dumps({"run": folder.name, **answer(folder, asked.without)}) + "\n")
                out.flush()
            except AgentError as error:
                print(f"run {folder.name}: {error}", file=sys.stderr)


def answer(folder: Path, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Verdict and causes of one run.

    Raises:
        AgentError: logs that cannot be used.
    """
    robot = load_robot(folder / "robot.yaml")
    baseline, logs = (
        [read_log(path, robot) for path in sorted((folder / session).glob("*.mcap"))]
        for session in ("baseline", "logs")
    )
    model = estimate(robot, baseline, EstimationSettings.create())
    usual = usual_effects(robot, baseline, model.cutoff)
    fit = assemble(robot, model, logs, None).fit
    decision = Search(fit, without, on(fit, usual)).run()
    causes = [
        {**_named(robot, place), "probability": p, "equivalent_to": [_named(robot, other) for other in rivals]}
        for place, rivals, p in decision.causes
    ]
    return {"verdict": decision.verdict, "causes": causes, "where": []}


def _named(robot: RobotDescription, place: Where) -> dict[str, Any]:
    return {"effect": place[0], "joints": [robot.joint_names[joint] for joint in place[1]]}


if __name__ == "__main__":
    main()
