"""The catalogue: the fitted form of every effect of the vocabulary, one file each."""

from agent.diagnosis.effects.asymmetric_friction import AsymmetricFriction
from agent.diagnosis.effects.backlash import Backlash
from agent.diagnosis.effects.base_tilt import BaseTilt
from agent.diagnosis.effects.contact import Contact
from agent.diagnosis.effects.dress_pack import DressPack
from agent.diagnosis.effects.effect import Columns, Effect
from agent.diagnosis.effects.encoder_offset import EncoderOffset
from agent.diagnosis.effects.friction_change import FrictionChange
from agent.diagnosis.effects.gravity_spring import GravitySpring
from agent.diagnosis.effects.inertial_mismatch import InertialMismatch
from agent.diagnosis.effects.interpolator_mismatch import InterpolatorMismatch
from agent.diagnosis.effects.joint_elasticity import JointElasticity
from agent.diagnosis.effects.load_dependent_friction import LoadDependentFriction
from agent.diagnosis.effects.payload import Payload
from agent.diagnosis.effects.presliding import Presliding
from agent.diagnosis.effects.stribeck import Stribeck
from agent.diagnosis.effects.thermal_friction import ThermalFriction
from agent.diagnosis.effects.time_delay import TimeDelay
from agent.diagnosis.effects.torque_constant import TorqueConstant
from agent.diagnosis.effects.torque_offset import TorqueOffset
from agent.diagnosis.effects.torque_ripple import TorqueRipple
from agent.diagnosis.effects.viscous_nonlinearity import ViscousNonlinearity
from agent.diagnosis.effects.wrist_coupling import WristCoupling

_ALL: tuple[Effect, ...] = (
    Stribeck(),
    AsymmetricFriction(),
    LoadDependentFriction(),
    ViscousNonlinearity(),
    ThermalFriction(),
    Presliding(),
    FrictionChange(),
    JointElasticity(),
    Backlash(),
    TorqueRipple(),
    WristCoupling(),
    Payload(),
    GravitySpring(),
    DressPack(),
    BaseTilt(),
    InertialMismatch(),
    Contact(),
    TorqueConstant(),
    TorqueOffset(),
    TimeDelay(),
    EncoderOffset(),
    InterpolatorMismatch(),
)

#: Effects by name, in the order of the vocabulary.
CATALOGUE: dict[str, Effect] = {effect.name: effect for effect in _ALL}

__all__ = ["CATALOGUE", "Columns", "Effect"]
