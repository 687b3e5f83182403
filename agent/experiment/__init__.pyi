from .baselines import (
    Pick as Pick,
    as_drawn as as_drawn,
    d_optimal as d_optimal,
    pieces_otherwise as pieces_otherwise,
)
from .deadline import Deadline as Deadline, OutOfTime as OutOfTime
from .piece_choice import Expected as Expected, Experiment as Experiment, plan_experiment as plan_experiment
from .pieces import KINDS as KINDS, Piece as Piece
from .questions import OpenPair as OpenPair, open_pairs as open_pairs
from .scorer import ExperimentScorer as ExperimentScorer, tells_apart_by_load as tells_apart_by_load
