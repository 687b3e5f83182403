from .deadline import Deadline as Deadline, OutOfTime as OutOfTime
from .known_mass import LONGEST as LONGEST, WithMass as WithMass
from .next_motion import (
    DRIVES_OFF as DRIVES_OFF,
    NextMotion as NextMotion,
    NoMotion as NoMotion,
    clearer_with_mass as clearer_with_mass,
    plan_motion as plan_motion,
)
from .picking import Pick as Pick, d_optimal as d_optimal, fill_time as fill_time
from .piece_choice import Experiment as Experiment, plan_experiment as plan_experiment
from .pieces import KINDS as KINDS, Piece as Piece, Pieces as Pieces
from .questions import OpenPair as OpenPair, open_pairs as open_pairs
from .scorer import ExperimentScorer as ExperimentScorer, load_distinguishes as load_distinguishes
