"""Rotor and link on a spring stay finite in every posture."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from agent.model.effects.two_mass import leads


@pytest.mark.parametrize("gap", [0.0, 1e-3])
def test_a_link_that_is_light_in_some_posture_does_not_overflow(gap):
    time = np.arange(1500) / 500
    inertia = np.where(np.sin(2 * time) > 0, 10.0, 1e-4)
    motion = SimpleNamespace(
        time=time, q=time[:, None], link_load=100 * np.sin(9 * time)[:, None], mass=inertia[:, None, None]
    )
    stiffness, damping = np.array([5.0 * (2 * np.pi * 36) ** 2] * 2), np.array([0.04, 0.12])
    with np.errstate(all="raise", under="ignore"):
        (found,) = leads([motion], np.array([0, 0]), stiffness, np.array([gap, gap]), damping)
    assert np.abs(found[0]).max() < 1e4, "the spring carries the load, and rings at most"
