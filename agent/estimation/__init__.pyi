from .estimators import ESTIMATORS as ESTIMATORS, Estimator as Estimator
from .identification import (
    EstimationSettings as EstimationSettings,
    estimate as estimate,
)
from .late_torque import torque_delay as torque_delay, with_torque_in_time as with_torque_in_time
from .model_building import beyond_fit as beyond_fit, known_positions as known_positions
from .normal_equations import inverse as inverse, solve_scaled as solve_scaled
from .prior import DESCRIPTION as DESCRIPTION, EITHER as EITHER, physical_prior as physical_prior
from .refitting import Refit as Refit, conditional_covariance as conditional_covariance, refit as refit
from .selection import are_placeholders as are_placeholders
from .signals.filtering import (
    FilterSettings as FilterSettings,
    Motion as Motion,
    bands as bands,
    motions as motions,
    resolve_cutoff as resolve_cutoff,
    smooth_and_differentiate as smooth_and_differentiate,
    used_text as used_text,
)
from .signals.observation import Observation as Observation, check_log as check_log, observe as observe
