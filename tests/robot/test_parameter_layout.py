"""Where standard parameters stand: one order for names, regressors and bodies."""

import numpy as np

from agent.robot import Dynamics, ParameterLayout, load_robot, rigid_bodies


def test_the_layout_fits_the_regressor_and_its_names():
    robot = load_robot("comau_ns16")
    layout = ParameterLayout.of(robot)
    bodies = rigid_bodies(robot)
    names = bodies.standard_names
    assert names == layout.names
    assert bodies.projection.shape[1] == layout.size == len(names)
    assert names[layout.link(2).start] == "m3"
    assert names[layout.rotors] == tuple(f"J{k + 1}" for k in range(robot.dof))
    masses = layout.blocks(Dynamics(robot).standard_parameters())[:, 0]
    assert masses.shape == (robot.dof,)
    assert (masses > 0).all()


def test_links_and_drives_may_differ_in_number():
    layout = ParameterLayout(n_links=8, n_rotors=6)
    standard = np.arange(layout.size)
    assert len(layout.names) == 86
    assert np.array_equal(np.concatenate([layout.blocks(standard).ravel(), standard[layout.rotors]]), standard)
