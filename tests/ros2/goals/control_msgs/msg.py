"""Messages: tolerances by their fields, and the controller's state, whose bytes the emulated arm writes itself."""

from dataclasses import dataclass

from std_msgs.msg import String


@dataclass
class JointTolerance:
    """One joint's; the real one has these fields."""

    name: str = ""
    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 0.0


class JointTrajectoryControllerState(String):
    """Its bytes are published and received raw, so what a text would be makes no difference."""

    @classmethod
    def get_fields_and_field_types(cls):
        return {"reference": "", "feedback": "", "speed_scaling_factor": "double"}
