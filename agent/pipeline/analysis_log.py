"""The analysis log: what was measured and what the model says of it, as topics that lie over each other."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agent.recording import FILTERED, PREDICTED, RESIDUAL, Log, LogFile, as_samples

if TYPE_CHECKING:
    from agent.validation import Prediction


def write_analysis(path: Path, log: Log, prediction: Prediction) -> Path:
    """Write a log with its prediction beside it; an existing file is replaced.

    /joint_states is as measured. /filtered_joint_states, /predicted_joint_states and /residual_joint_states have the
    torque that the model is judged by: both filtered alike, edges dropped, on the same stamps as the measurement.

    Raises:
        RecordingError: the file cannot be written.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    with suppress(OSError):
        beside.unlink()
    run = {"robot": log.metadata.get("robot", ""), "motion": log.metadata.get("motion", "")}
    times = log.stamp + log.t
    file = LogFile(beside, log.joint_names, run["robot"], run["motion"], log.sample_rate, clock=lambda: times[0])
    try:
        file.write(as_samples(log))
        stamps = log.stamp + prediction.time
        position = np.stack([np.interp(prediction.time, log.t, q) for q in log.position.T], axis=1)
        for topic, torque in (
            (FILTERED, prediction.measured),
            (PREDICTED, prediction.predicted),
            (RESIDUAL, prediction.error),
        ):
            file.write_states(topic, stamps, position, prediction.velocity, torque)
        for start in log.cycle_starts:
            file.cycle_start(log.stamp + start)
        file.finish()
        file.close()
        os.replace(beside, path)
    finally:
        file.close()
        with suppress(OSError):
            beside.unlink()
    return path
