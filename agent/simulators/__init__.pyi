from .arm import SimulatedArm as SimulatedArm, model_of as model_of
from .corrected.corrected_file import write_corrected as write_corrected, written_files as written_files
from .corrected.correction import (
    Correction as Correction,
    FittedChange as FittedChange,
    Released as Released,
    correct as correct,
    with_servos as with_servos,
)
from .effect_numbers import reversal_over as reversal_over
from .export import export_model as export_model, export_table as export_table
from .forward_simulation import (
    ExternalTorque as ExternalTorque,
    ForwardSimulation as ForwardSimulation,
    RigidActuation as RigidActuation,
    ServoGains as ServoGains,
    SimulatedMotion as SimulatedMotion,
)
from .free_motion import (
    KINDS as KINDS,
    LOST as LOST,
    FreeMotion as FreeMotion,
    FreeSimulator as FreeSimulator,
    RecordedCommand as RecordedCommand,
    ServoNumbers as ServoNumbers,
)
from .joints import load_joint_map as load_joint_map
from .loader import (
    Simulator as Simulator,
    is_simulator as is_simulator,
    load_arm as load_arm,
    load_arm_of as load_arm_of,
    load_simulator as load_simulator,
)
from .loads import VENDORS as VENDORS, identified_load as identified_load, load_text as load_text
from .mjcf import compiled as compiled, mujoco_package as mujoco_package
from .servos import PositionServos as PositionServos
from .targets import TARGETS as TARGETS, numbers_of_file as numbers_of_file, write_target as write_target
