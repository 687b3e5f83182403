"""The experiment that tells what a diagnosis leaves open: which motion, and what it is expected to say."""

from agent.experiment.plan import Expected, Experiment, plan_experiment
from agent.experiment.questions import OpenPair, open_pairs

__all__ = ["Expected", "Experiment", "OpenPair", "open_pairs", "plan_experiment"]
