from .effect_inputs import MotionSignals as MotionSignals, NominalModel as NominalModel
from .effect_prediction import effect_torque as effect_torque, known_effects as known_effects
from .effects import CATALOGUE as CATALOGUE
from .effects.base_tilt import across as across
from .effects.effect import (
    BELOW_ZERO as BELOW_ZERO,
    REVERSAL_TRAVELS as REVERSAL_TRAVELS,
    Columns as Columns,
    Effect as Effect,
    FitContext as FitContext,
)
from .effects.payload import ball as ball
from .effects.simulator_numbers import FileNumbers as FileNumbers, SimulatorNumbers as SimulatorNumbers
from .friction_terms import (
    FORMS as FORMS,
    ODD as ODD,
    AxleMotion as AxleMotion,
    FrictionTerm as FrictionTerm,
    Reversal as Reversal,
    axle_columns as axle_columns,
    steady_columns as steady_columns,
)
from .identified_model import (
    BAD_CONDITION as BAD_CONDITION,
    USUAL_CONDITION as USUAL_CONDITION,
    IdentifiedModel as IdentifiedModel,
    condition_text as condition_text,
    judged_condition as judged_condition,
)
from .known_load import (
    PAYLOAD as PAYLOAD,
    carrying as carrying,
    known_payload as known_payload,
    payload_of as payload_of,
    payload_text as payload_text,
)
from .passive_forces import Bristles as Bristles, PassiveForces as PassiveForces
from .regimes import (
    REGIMES as REGIMES,
    RESTS as RESTS,
    regime_masks as regime_masks,
    standstill_speed as standstill_speed,
)
from .rigid_friction import (
    SIMULATOR as SIMULATOR,
    HealthyEffect as HealthyEffect,
    ModelEffect as ModelEffect,
    ParameterPrior as ParameterPrior,
    RigidFrictionModel as RigidFrictionModel,
)
from .standard_parameters import (
    PSEUDO_INERTIA as PSEUDO_INERTIA,
    body_parameters as body_parameters,
    check_physical as check_physical,
    full_parameters as full_parameters,
    is_body as is_body,
    link_scale as link_scale,
    nearby_body as nearby_body,
    nearest_bodies as nearest_bodies,
    possible_model as possible_model,
    pseudo_inertia as pseudo_inertia,
    seen_from as seen_from,
)
