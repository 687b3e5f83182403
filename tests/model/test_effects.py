"""What an effect says of itself, as data."""

import pytest

from agent.model import CATALOGUE


@pytest.mark.parametrize(
    ("effect", "settings", "counted"),
    [
        ("stribeck", {"speed": 0.1, "shape": 1.0}, 2),
        ("stribeck", {"speed": 0.1, "shape": 1.0, "reversal_travel": 0.01}, 3),
        ("viscous_nonlinearity", {"power": 2.0}, 1),
        ("thermal_friction", {"way": 2.0, "session": 1.0}, 1),
        ("load_dependent_friction", {"power": 2.0, "load": 30.0}, 1),
        ("load_dependent_friction", {"links": 1.0, "driven": 1.0}, 0),
        ("friction_change", {"coulomb": 1.0, "reversal_travel": 0.01}, 1),
        ("joint_elasticity", {"stiffness": 1e4, "damping": 0.1}, 1),
        ("torque_ripple", {"order": 40.0, "harmonics": 2.0}, 1),
        ("wrist_coupling", {"ratio": 0.3, "free": 1.0}, 1),
        ("time_delay", {"delay": 0.002}, 0),
        ("contact", {"log_1": 0.0, "link_1": 2.0, "start_1": 1.0, "duration_1": 0.5}, 4),
        ("payload", {"m0": 1.0, "hx0": 0.0, "hy0": 0.0, "hz0": 0.1}, 0),
        ("inertial_mismatch", {"link": 2.0}, 0),
    ],
)
def test_only_fitted_nonlinear_parameters_cost_evidence(effect, settings, counted):
    assert CATALOGUE[effect].counted(settings) == counted


def test_a_finer_search_moves_one_parameter_at_a_time_both_ways():
    settings = {"speed": 0.1, "shape": 1.0, "reversal_travel": 0.01}
    found = CATALOGUE["stribeck"].nearby(settings, 2.0)
    moved = [
        {name: entry[name] / settings[name] for name in settings if entry[name] != settings[name]} for entry in found
    ]
    assert moved == [{"speed": 0.5}, {"speed": 2.0}, {"reversal_travel": 0.5}, {"reversal_travel": 2.0}]
