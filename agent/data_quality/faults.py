"""Findings of the checks of recorded data, and the recordings that are checked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from agent.data_quality.rigid_fit import FitSamples, fit_samples
from agent.recording import Log
from agent.robot import RobotDescription

MOVING = 1e-2  #: rad or m that a joint travels to count as moving


@dataclass(frozen=True)
class QualityFinding:
    """One thing that is wrong with logs.

    text: what, with its figures. joints: whose. share: part of the samples that it spoils. advice: what to do.
    refuses: whether no model may be made of such logs. scale: the doubt is about the size of torques, which a model
    that predicts those torques refutes.
    """

    text: str
    joints: tuple[str, ...] = ()
    share: float = 1.0
    advice: str = ""
    refuses: bool = True
    scale: bool = False

    def __str__(self) -> str:
        return f"{self.text}; {self.advice}" if self.advice else self.text


@dataclass(frozen=True, eq=False)
class Recordings:
    """Logs with torque of one robot; `others` are further motions of the same recorder, which a doubt about little data
    has to stand up to. `predicted` says whether a fitted model predicts the logs, so that nothing is mistaken in them.
    """

    robot: RobotDescription
    logs: Sequence[Log]
    others: Sequence[Log] = ()
    predicted: Callable[[], bool] = lambda: False

    @cached_property
    def samples(self) -> FitSamples | None:
        """Low-passed samples of the logs; None where they are too few."""
        return fit_samples(self.logs)

    @cached_property
    def turning(self) -> np.ndarray:
        """(n,) joints that turn, as opposed to slides."""
        return ~np.array([joint.prismatic for joint in self.robot.joints])

    @cached_property
    def efforts(self) -> list[np.ndarray]:
        """(S, n) torque of every log [N·m or N]."""
        return [log.effort for log in self.logs if log.effort is not None]

    @cached_property
    def moving(self) -> np.ndarray:
        """(n,) joints that move."""
        return travel(self.logs) > MOVING

    def named(self, which: np.ndarray) -> tuple[str, ...]:
        """Names of the joints of a mask (n,) or of numbers."""
        return tuple(np.array(self.robot.joint_names)[which].tolist())


def travel(logs: Sequence[Log]) -> np.ndarray:
    """(n,) distance between the lowest and the highest position in all logs [rad or m]."""
    low, high = (f([f(log.position, axis=0) for log in logs], axis=0) for f in (np.min, np.max))
    return np.asarray(high - low)
