"""What a simulator is driven with."""

from __future__ import annotations

import numpy as np

from agent.diagnosis.forward.rollout import at_motors
from agent.model.rigid_friction import ModelEffect


def test_motor_torque_is_the_reported_torque_without_measurement_errors():
    motors = np.array([[3.0, -2.0], [1.0, 5.0]])
    reported = motors * [1.0, 1.1] + [0.0, 4.0]
    found = [
        ModelEffect("torque_constant", ("b",), {"scale_error": 0.1}),
        ModelEffect("payload", (), {"mass": 3.0}),
        ModelEffect("torque_offset", ("b",), {"offset": 4.0}),
    ]
    np.testing.assert_allclose(at_motors(found, ("a", "b"), reported), motors)
