"""Arms with position servos that record positions and commands, no torque: a world of the blind check.

Not in MuJoCo, where a fit in MuJoCo would have no model error: bodies by Pinocchio, friction of bristles, gears and
loads of `fake_controller.actuation`, servos with states.
"""
