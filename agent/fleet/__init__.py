"""The same over many robots: one task a robot and run, on the cores of this machine or a Dask scheduler."""

from agent.fleet.job import Summary, run_fleet
from agent.fleet.tasks import KINDS, RunQuestion, make_question

__all__ = ["KINDS", "RunQuestion", "Summary", "make_question", "run_fleet"]
