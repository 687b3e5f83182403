"""The time that planning may take: said with what is being done, shared between stages, and kept to."""

from __future__ import annotations

import pytest

from agent.experiment import Deadline, OutOfTime
from agent.experiment.choice import best_rehearsed


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_time_left_is_shown_until_there_is_none():
    clock, said = Clock(), list[str]()
    deadline = Deadline(said.append, 60.0, clock)
    deadline("weighing")
    clock.now += 20
    deadline.share(0.5)("varying")
    assert said == ["weighing, at most 60 s of planning left", "varying, at most 40 s of planning left"]
    clock.now += 10
    with pytest.raises(OutOfTime):
        deadline.share(0.5)("varying")
    deadline("rehearsing")
    assert deadline.rest().share(0.5).left == pytest.approx(15)
    Deadline(said.append)("no limit")
    assert said[-1] == "no limit"


def test_the_best_motion_so_far_is_taken_when_the_time_is_up():
    clock, told = Clock(), list[int]()
    deadline = Deadline(lambda text: None, 60.0, clock)
    designs = [["first"], ["second"], ["third"], ["fourth"]]
    worth = {"first": 0.2, "second": 0.9, "third": 0.4, "fourth": 1.0}

    def settled(design, draws, seed):
        told.append(draws)
        clock.now += 25
        return worth[design[0]]

    assert best_rehearsed(designs, settled, 1, deadline) == ["second"]
    assert len(told) == 3, "no rehearsal begins after the time is up"
