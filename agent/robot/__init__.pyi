from .base_reduction import base_parameters as base_parameters
from .bodies import RigidBodies as RigidBodies, rigid_bodies as rigid_bodies
from .cell import Cell as Cell, position_ranges as position_ranges
from .clearance import CellReport as CellReport
from .collision import Body as Body, CollisionModel as CollisionModel
from .description import (
    Box as Box,
    Capsule as Capsule,
    CartesianLimits as CartesianLimits,
    Joint as Joint,
    RobotDescription as RobotDescription,
    builtin_robots as builtin_robots,
    description_file as description_file,
    is_gripper as is_gripper,
    load_robot as load_robot,
)
from .drivetrain import (
    PAPER_TERMS as PAPER_TERMS,
    axle_motion as axle_motion,
    friction_regressor as friction_regressor,
    rotor_mass_matrix as rotor_mass_matrix,
    rotor_regressor as rotor_regressor,
    torque_per_ampere as torque_per_ampere,
)
from .dynamics import Dynamics as Dynamics, Tool as Tool
from .kinematics import kinematics_for as kinematics_for
from .kinematics.base import (
    Kinematics as Kinematics,
    KinematicsError as KinematicsError,
)
from .kinematics.chain import chain_of as chain_of, joint_axes as joint_axes
from .kinematics.configuration import parse_configuration as parse_configuration
from .kinematics.numerical import NumericalKinematics as NumericalKinematics
from .parameter_layout import (
    LINK_PARAMETERS as LINK_PARAMETERS,
    ParameterLayout as ParameterLayout,
    about_centre as about_centre,
)
from .torque_figures import (
    SHARE as SHARE,
    error_units as error_units,
    figure_text as figure_text,
    not_judged_text as not_judged_text,
    outcome_text as outcome_text,
    position_units as position_units,
    torque_units as torque_units,
    without_nominal as without_nominal,
)
from .torque_limits import TorqueLimits as TorqueLimits
from .urdf_checks import check_urdf as check_urdf, parse_robot_file as parse_robot_file
