"""The first screen of a diagnosis: the four things, and the machine, logs and model they are about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agent.core import package_version
from agent.diagnosis import Diagnosis
from agent.model import PAYLOAD
from agent.recording import Log, machines_of
from agent.report.arm import arm_picture
from agent.report.page import About, NextStep
from agent.report.phrasing import FOUR, measures, summary


def about_diagnosis(diagnosis: Diagnosis, next_steps: Sequence[NextStep], result: Mapping[str, Any]) -> About:
    """What stands on the first screen below the verdict; `next_steps` are commands that whoever asked can run."""
    dataset = diagnosis.dataset
    asked = (
        "What does the robot have that the model lacks?"
        if dataset.given
        else "What do these motions show that links and friction cannot explain?"
    )
    said = summary(result)
    facts = [(title, said[key]) for key, title in FOUR.items() if key != "next"]
    marked = result["causes"][0]["joints"] if result["causes"] else []
    first = dataset.logs[0].position
    picture = arm_picture(dataset.robot, first[len(first) // 2], marked) if marked else ""
    return About(asked, facts, [*measures(result), *next_steps], _identity(diagnosis), picture)


def _recorded(logs: Sequence[Log]) -> str:
    """When, where the clock of every log shows a date."""
    dates = sorted(log.date for log in logs if log.date is not None)
    if len(dates) < len(logs):
        return "no date in the logs"
    first, last = (date.strftime("%Y-%m-%d %H:%M UTC") for date in (dates[0], dates[-1]))
    return first if first == last else f"{first} to {last}"


def _identity(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    dataset = diagnosis.dataset
    machines = machines_of(dataset.logs)
    model = f"{dataset.model.method}, {len(dataset.model.values)} parameters"
    return [
        ("robot", dataset.robot.name),
        *((key, ", ".join(values) or "not reported") for key, values in machines.items()),
        *(
            ("mass at the flange", f"{load} ({log.name})")
            for log in dataset.logs
            if (load := log.metadata.get(PAYLOAD))
        ),
        ("recorded", _recorded(dataset.logs)),
        ("logs", str(len(dataset.logs))),
        ("model", model if dataset.given else f"fitted to these logs: {model}"),
        ("program", f"calibration-agent {package_version()}"),
    ]
