"""Fresh data against the last accepted model: where it predicts worse than it did, the diagnosis runs by itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import AgentError, Console
from agent.model import standstill_speed
from agent.runs import RunFolder

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.pipeline.until_sure import Found, Rounds
    from agent.recording import Log
    from agent.validation import Prediction

#: Error may be this much above that at the model's own calibration, and this part of the nominal torque more.
WORSE = 1.25
FLOOR = 1e-3
#: Without a nominal torque the model's own error is the only scale there is, and it scatters from run to run.
WORSE_UNSCALED = 1.5


def worse_joints(model: IdentifiedModel, rmse: np.ndarray) -> list[str]:
    """Joints whose error (n,) [N·m] is above that of the model on its own data."""
    nominal = model.robot.nominal_torque
    unscaled = WORSE_UNSCALED * model.held_out_rmse
    limit = np.where(np.isnan(nominal), unscaled, WORSE * model.held_out_rmse + FLOOR * nominal)
    return [name for name, above in zip(model.robot.joint_names, rmse > limit, strict=True) if above]


def joint_moves(prediction: Prediction) -> np.ndarray:
    """(S, n) bool."""
    slowest = standstill_speed([prediction.velocity], prediction.model.robot.max_velocity)
    return np.abs(prediction.velocity) > slowest


def moving_rmse(prediction: Prediction) -> np.ndarray:
    """(n,) [N·m] over the samples in which each joint itself moves."""
    moving = joint_moves(prediction)
    return np.sqrt(np.sum(prediction.error**2 * moving, axis=0) / np.maximum(1, moving.sum(axis=0)))


def diagnose_if_worse(
    model: IdentifiedModel,
    worse: list[str],
    log: Log,
    run: RunFolder,
    console: Console,
    ask: Callable[[Callable[[Sequence[Path]], Found]], Rounds] | None = None,
) -> dict[str, Any] | None:
    """Why the last accepted model predicts the joints `worse` worse than it did; None where there are none.

    Args:
        ask: further motions, given the diagnosis of `log` and of what they recorded (`until_sure`).

    Returns:
        `summary`, a sentence or two; `result`, as in docs/diagnosis.md (None where it could not be diagnosed), which
        the run folder gets as `diagnosis.json`.
    """
    from agent.diagnosis import diagnose
    from agent.recording import read_log
    from agent.report import diagnosis_summary

    if not worse:
        return None
    opening = f"The last model predicts {', '.join(worse)} worse than it did."
    console.step(f"{opening} Diagnosing")

    def find(further: Sequence[Path]) -> Found:
        return diagnose(model.robot, [log, *(read_log(path, model.robot) for path in further)], model), [], None

    try:
        if ask is None:
            found = find([])[0].result
        else:
            rounds = ask(find)
            found = {**rounds.last[0].result, **rounds.to_dict()}
    except AgentError as error:
        return {"summary": f"{opening} It could not be diagnosed: {error}", "result": None}
    run.write_json("diagnosis.json", found)
    return {"summary": f"{opening} {diagnosis_summary(found)}", "result": found}
