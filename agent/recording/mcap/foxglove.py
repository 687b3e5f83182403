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
_PLOT = {
    "xAxisVal": "timestamp",
    "showLegend": True,
    "legendDisplay": "floating",
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "isSynced": True,
}


def foxglove_layout(joint_names: Sequence[str]) -> str:
    """JSON text of a layout for these joints."""
    plots = {
        f"Plot!torque-{k}": (
            f"torque of {joint} [N·m]",
            [
                _line(f"/joint_states.effort[{k}]", "measured", "#9aa4ae"),
                _line(f"{FILTERED}.effort[{k}]", "measured, filtered", "#3b82c4"),
                _line(f"{PREDICTED}.effort[{k}]", "predicted", "#d9822b"),
            ],
        )
        for k, joint in enumerate(joint_names)
    }
    residuals, positions = [], []
    for k, joint in enumerate(joint_names):
        residuals.append(_line(f"{RESIDUAL}.effort[{k}]", joint))
        positions.append(_line(f"/joint_states.position[{k}]", joint))
        positions.append(_line(f"/joint_references.position[{k}]", f"{joint} set-point"))
    torques = list(plots)
    plots["Plot!residual"] = "residual torque [N·m]", residuals
    plots["Plot!position"] = "position and its set-point [rad]", positions
    panels: dict[str, Any] = {
        panel: {"foxglovePanelTitle": title, "paths": lines, **_PLOT} for panel, (title, lines) in plots.items()
    }
    panels["RawMessages!status"] = {"topicPath": "/controller_status", "diffEnabled": False}
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _column(torques),
            "second": _column(["Plot!residual", "Plot!position", "RawMessages!status"]),
            "splitPercentage": 60,
        },
    }
    return json.dumps(layout, indent=1) + "\n"


def _line(path: str, label: str, colour: str | None = None) -> dict[str, Any]:
    line = {"value": path, "label": label, "enabled": True, "timestampMethod": "headerStamp"}
    return line if colour is None else {**line, "color": colour}


def _column(panels: Sequence[str]) -> Any:
    """Equal parts one above the other, nested as Foxglove nests them."""
    if len(panels) == 1:
        return panels[0]
    below = _column(panels[1:])
    return {"direction": "column", "first": panels[0], "second": below, "splitPercentage": 100 / len(panels)}
