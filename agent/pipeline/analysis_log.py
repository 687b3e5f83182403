"""The analysis log: what was measured and what the model says of it, as topics that lie over each other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.recording import FILTERED, PREDICTED, RESIDUAL, Log, write_log

if TYPE_CHECKING:
    from agent.validation import Prediction


def write_analysis(path: Path, log: Log, prediction: Prediction) -> None:
    """Write a log with its prediction beside it; an existing file is replaced.

    /joint_states is as measured. /filtered_joint_states, /predicted_joint_states and /residual_joint_states have the
    torque that the model is judged by: both filtered alike, edges dropped, on the same stamps as the measurement.

    Raises:
        RecordingError: the file cannot be written.
    """
    position = np.stack([np.interp(prediction.time, log.t, q) for q in log.position.T], axis=1)
    torques = {FILTERED: prediction.measured, PREDICTED: prediction.predicted, RESIDUAL: prediction.error}
    states = {topic: (prediction.time, position, prediction.velocity, torque) for topic, torque in torques.items()}
    write_log(path, replace(log, reference_position=None, planned_position=None), states)
