from .compare import BEYOND as BEYOND, Comparison as Comparison, compare_models as compare_models
from .other_robot import is_of_another_robot as is_of_another_robot
from .singular_values import observability as observability
from .torque import (
    Prediction as Prediction,
    Validation as Validation,
    flipped_joints as flipped_joints,
    pooled_rmse as pooled_rmse,
    predict_log as predict_log,
    predicts as predicts,
    same_scale as same_scale,
    summary as summary,
    validate as validate,
)
from .torque_scale import torque_scales as torque_scales
