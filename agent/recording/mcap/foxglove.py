"""A Foxglove layout for the logs of an arm: measured torque under predicted, residuals, positions on their set-points.

It is attached to every log as `foxglove-layout.json`: in Foxglove, Layouts > Import from file. Topics that a log does
not have leave their lines empty.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

FOXGLOVE_LAYOUT = "foxglove-layout.json"
PREDICTED = "/predicted_joint_states"
FILTERED = "/filtered_joint_states"
RESIDUAL = "/residual_joint_states"
_COLOURS = {"measured": "#9aa4ae", "filtered": "#3b82c4", "predicted": "#d9822b", "residual": "#c75d8a"}


def foxglove_layout(joint_names: Sequence[str]) -> str:
    """JSON text of a layout for these joints."""
    panels: dict[str, Any] = {}
    torque = [
        _plot(panels, f"torque-{k}", f"torque of {joint} [N·m]", _torque(k)) for k, joint in enumerate(joint_names)
    ]
    residual = _plot(
        panels,
        "residual",
        "residual torque [N·m]",
        [_line(f"{RESIDUAL}.effort[{k}]", joint, None) for k, joint in enumerate(joint_names)],
    )
    position = _plot(
        panels,
        "position",
        "position and its set-point [rad]",
        [
            line
            for k, joint in enumerate(joint_names)
            for line in (
                _line(f"/joint_states.position[{k}]", joint, None),
                _line(f"/joint_references.position[{k}]", f"{joint} set-point", None),
            )
        ],
    )
    panels["RawMessages!status"] = {"topicPath": "/controller_status", "diffEnabled": False}
    side = _split([residual, position, "RawMessages!status"], "column")
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _split(torque, "column"),
            "second": side,
            "splitPercentage": 60,
        },
    }
    return json.dumps(layout, indent=1) + "\n"


def _torque(joint: int) -> list[dict[str, Any]]:
    return [
        _line(f"/joint_states.effort[{joint}]", "measured", _COLOURS["measured"]),
        _line(f"{FILTERED}.effort[{joint}]", "measured, filtered", _COLOURS["filtered"]),
        _line(f"{PREDICTED}.effort[{joint}]", "predicted", _COLOURS["predicted"]),
    ]


def _line(path: str, label: str, colour: str | None) -> dict[str, Any]:
    line = {"value": path, "label": label, "enabled": True, "timestampMethod": "headerStamp"}
    return line if colour is None else {**line, "color": colour}


def _plot(panels: dict[str, Any], name: str, title: str, lines: list[dict[str, Any]]) -> str:
    panel = f"Plot!{name}"
    panels[panel] = {
        "foxglovePanelTitle": title,
        "paths": lines,
        "xAxisVal": "timestamp",
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
    }
    return panel


def _split(panels: Sequence[str], direction: str) -> Any:
    """Equal parts one after the other, nested as Foxglove nests them."""
    if len(panels) == 1:
        return panels[0]
    rest = _split(panels[1:], direction)
    return {"direction": direction, "first": panels[0], "second": rest, "splitPercentage": 100 / len(panels)}
