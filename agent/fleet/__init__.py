"""The same over many robots: one task a robot and run, on the cores of this machine or a Dask scheduler."""

from agent.fleet.job import Summary, run_fleet
from agent.fleet.tasks import KINDS, Question, make_question

__all__ = ["KINDS", "Question", "Summary", "make_question", "run_fleet"]
