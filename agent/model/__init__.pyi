from .effects import CATALOGUE as CATALOGUE
from .effects.effect import Columns as Columns, Effect as Effect, FitContext as FitContext
from .export import export_model as export_model, export_table as export_table
from .friction_terms import (
    FORMS as FORMS,
    ODD as ODD,
    AxleMotion as AxleMotion,
    FrictionTerm as FrictionTerm,
    Reversal as Reversal,
    axle_columns as axle_columns,
    steady_columns as steady_columns,
)
from .identified import (
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
from .nearest_bodies import possible_model as possible_model
from .regimes import REGIMES as REGIMES, regime_masks as regime_masks, standstill_speed as standstill_speed
from .rigid_friction import HealthyEffect as HealthyEffect, ModelEffect as ModelEffect, ParameterPrior as ParameterPrior
from .signals import MotionSignals as MotionSignals, NominalModel as NominalModel
from .simulators.arm import SIMULATOR as SIMULATOR
from .simulators.corrected_file import write_corrected as write_corrected, written_files as written_files
from .simulators.correction import (
    Commands as Commands,
    Correction as Correction,
    Released as Released,
    correct as correct,
)
from .simulators.joints import load_joint_map as load_joint_map
from .simulators.load import (
    Simulator as Simulator,
    is_simulator as is_simulator,
    load_arm as load_arm,
    load_simulator as load_simulator,
)
from .simulators.mjcf import compiled as compiled, mujoco_package as mujoco_package
from .simulators.servos import (
    SERVO_STIFFNESS as SERVO_STIFFNESS,
    PositionServos as PositionServos,
    servo_stiffness as servo_stiffness,
)
from .standard_parameters import full_parameters as full_parameters
from .with_effects import effect_torque as effect_torque
