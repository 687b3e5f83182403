"""The catalogue: the fitted form of every effect of the vocabulary, one file each, and what others install."""

from agent.model.effects.asymmetric_friction import AsymmetricFriction
from agent.model.effects.backlash import Backlash
from agent.model.effects.base_tilt import BaseTilt
from agent.model.effects.contact import Contact
from agent.model.effects.dress_pack import DressPack
from agent.model.effects.effect import Columns, Effect, FitContext
from agent.model.effects.encoder_offset import EncoderOffset
from agent.model.effects.experiments import SeparatingMotion
from agent.model.effects.friction_change import FrictionChange
from agent.model.effects.gravity_spring import GravitySpring
from agent.model.effects.inertial_mismatch import InertialMismatch
from agent.model.effects.interpolator_mismatch import InterpolatorMismatch
from agent.model.effects.joint_elasticity import JointElasticity
from agent.model.effects.load_dependent_friction import LoadDependentFriction
from agent.model.effects.payload import Payload
from agent.model.effects.presliding import Presliding
from agent.model.effects.registry import GROUP, Catalogue
from agent.model.effects.stribeck import Stribeck
from agent.model.effects.thermal_friction import ThermalFriction
from agent.model.effects.time_delay import TimeDelay
from agent.model.effects.torque_constant import TorqueConstant
from agent.model.effects.torque_offset import TorqueOffset
from agent.model.effects.torque_ripple import TorqueRipple
from agent.model.effects.viscous_nonlinearity import ViscousNonlinearity
from agent.model.effects.wrist_coupling import WristCoupling

#: Effects by name, the built-in ones in the order of the vocabulary.
CATALOGUE = Catalogue(
    (
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
)

__all__ = ["CATALOGUE", "GROUP", "Columns", "Effect", "FitContext", "SeparatingMotion"]
