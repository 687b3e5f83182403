from .otherwise import Choice as Choice, d_optimal_pieces as d_optimal_pieces, random_pieces as random_pieces
from .pieces import Piece as Piece
from .plan import Experiment as Experiment, plan_experiment as plan_experiment
from .questions import OpenPair as OpenPair, open_pairs as open_pairs
