"""The time that planning may take: said with what is being done, shared between stages, and kept to."""

import pytest

from agent.experiment import Deadline, OutOfTime


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_shows_the_remaining_time():
    clock, said = Clock(), list[str]()
    deadline = Deadline(said.append, 60.0, clock)
    deadline("weighing")
    clock.now += 20
    deadline.share(0.5)("varying")
    assert said == ["weighing, at most 60 s of planning left", "varying, at most 40 s of planning left"]
    clock.now += 10
    with pytest.raises(OutOfTime):
        deadline.share(0.5)("varying")
    deadline("weighing again")
    assert deadline.from_now().share(0.5).remaining == pytest.approx(15)
    Deadline(said.append)("no limit")
    assert said[-1] == "no limit"
