from .pieces import Piece as Piece
from .plan import Experiment as Experiment, plan_experiment as plan_experiment
from .questions import OpenPair as OpenPair, open_pairs as open_pairs
