"""A constant is a constant: one that leaves more than a constant would is not all there is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from agent.diagnosis.dataset import assemble
from agent.diagnosis.excess import exact_but_for_more
from agent.diagnosis.limits import LIMITS
from agent.model import CATALOGUE


@pytest.mark.parametrize(("wanders", "more"), [(0.0, False), (0.3, True)])
def test_an_offset_that_leaves_more_than_a_constant_would_is_not_all(arm, baseline, runs, wanders, more):
    """What is added to joint_2 wanders slowly about 3 % of nominal, by no law of the catalogue."""
    logs = []
    for number, log in enumerate(runs(0)):
        effort = log.effort.copy()
        about = 1 + wanders * np.sin(2 * np.pi * 0.37 * log.t + 2 * number)
        effort[:, 1] += 0.03 * arm.nominal_torque[1] * about
        logs.append(replace(log, effort=effort))
    base = assemble(arm, baseline, logs, None).fit

    def left(effect: str, *others: tuple[str, int]) -> bool:
        chosen = [base.candidate(CATALOGUE[name], (joint,), {}) for name, joint in ((effect, 1), *others)]
        return exact_but_for_more(LIMITS, base, base.with_chosen(chosen), chosen[0])

    assert left("torque_offset") is more
    assert left("torque_offset", ("torque_constant", 2)) is more, "what sits on another joint explains nothing here"
    assert not left("torque_offset", ("torque_constant", 1)), "that one errs in its form"
    assert not left("dress_pack"), "no form but an exact one has to leave nothing"
