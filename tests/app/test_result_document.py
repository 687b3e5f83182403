"""result.json: the keys and values that others read, in their order."""

from __future__ import annotations

import json

import numpy as np

from agent.core.console import finite
from agent.pipeline.result import (
    CalibrationResult,
    EstimationFigures,
    GateFigures,
    RecordingFigures,
    SearchFigures,
    ValidationFigures,
)

DOCUMENT = """
{"schema": "calibration/1", "robot": "arm", "accepted": true, "reason": "",
 "gate": {"normalised_rmse": 0.03, "not_judged": ["joint_2"]},
 "search": {"method": "genetic", "seed": 1, "fitness": 9.5, "evaluations": 20, "motion": "a loop"},
 "estimation": {"method": "weighted", "cutoff_hz": 30.0, "parameters": 24, "base_parameters": 12,
                "condition_number": 40.0, "notes": ["a note"]},
 "validation": {"motions": 2, "speed": 0.1, "joints": ["joint_1", "joint_2"], "units": ["N·m", "N·m"],
                "rmse": [1.0, 2.0], "normalised_rmse": [0.01, null], "normalised_rmse_all_samples": [0.02, null],
                "relative_error_all_joints": 0.05},
 "recordings": [{"log": "excitation.mcap", "samples": 100, "lost": 0, "duration": 0.2}],
 "provenance": {"run": "r"}, "serial": "s", "conditions": {"cycles": 2}, "reference": "", "diagnosis": null,
 "current_model": "r"}
"""


def test_the_result_document_has_the_published_keys():
    result = CalibrationResult(
        robot="arm",
        accepted=True,
        reason="",
        gate=GateFigures(0.03, ["joint_2"]),
        search=SearchFigures("genetic", 1, 9.5, 20, "a loop"),
        estimation=EstimationFigures("weighted", 30.0, 24, 12, 40.0, ["a note"]),
        validation=ValidationFigures(
            motions=2,
            speed=0.1,
            joints=["joint_1", "joint_2"],
            units=["N·m", "N·m"],
            rmse=np.array([1.0, 2.0]),
            normalised_rmse=np.array([0.01, np.nan]),
            normalised_rmse_all_samples=[0.02, None],
            relative_error_all_joints=0.05,
        ),
        recordings=[RecordingFigures("excitation.mcap", 100, 0, 0.2)],
        provenance={"run": "r"},
        serial="s",
        conditions={"cycles": 2},
        reference="",
        diagnosis=None,
        current_model="r",
    )
    assert json.dumps(finite(result.to_dict())) == json.dumps(json.loads(DOCUMENT))
