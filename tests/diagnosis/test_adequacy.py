"""A cause is named only if what it leaves of held-out motion looks like a healthy arm's remainder."""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from agent.diagnosis.gap.adequacy import LARGEST_ERROR, Adequacy, remainders
from agent.diagnosis.gap.torque_gap import HeldOutGap, held_out_gap, rms
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.hypotheses.selected_causes import Hypothesis, SelectedCauses
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.verdict import drop_replaceable
from agent.model import CATALOGUE
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

JOINTS = ("joint_1", "joint_2")
LONG = np.random.default_rng(0).normal(size=(4000, 5, 2))  # unit noise: model error and torques of four effects


def judged(
    *parts: tuple[float, ...], error: float | np.ndarray = 1.0, by_model: float = 0.0, against: float = 0.0
) -> list[str]:
    """Reasons against causes with these torques per joint; `by_model` is what the model's own change closes, `against`
    what it takes back of the first cause."""
    torque = [LONG[:, 1 + k] * np.array(sizes) for k, sizes in enumerate(parts)]
    left = error * LONG[:, 0]
    raw = left + sum(torque) + by_model * LONG[:, 4] - against * torque[0]
    return reasons(raw, left, torque, [SimpleNamespace(joints=tuple(np.flatnonzero(sizes))) for sizes in parts])


def reasons(
    raw: np.ndarray, left: np.ndarray, torque: Sequence[np.ndarray], causes: Sequence, irreplaceable: bool = False
) -> list[str]:
    """Reasons against causes with these torques (S, 2), between errors without and with them."""
    fit = SimpleNamespace(
        transient=False,
        keeps_parameters=True,
        chosen=(),
        rows=JOINTS,
        near_rest=np.zeros(left.shape, dtype=bool),
        sigma=np.ones(left.shape),
        held_out=lambda without=None: left if without is None else left + torque[without],
        reference=SimpleNamespace(robot=SimpleNamespace(joint_names=JOINTS)),
    )
    gap = HeldOutGap(raw, left, np.zeros(left.shape), np.ones(2), rms(raw), rms(left), None)
    return Adequacy(fit, gap, causes).shortfalls(lambda number: irreplaceable)


@given(st.floats(2, 50), st.floats(0.1, 1.3))
def test_a_cause_that_leaves_the_models_own_error_explains_what_it_claims(size, error):
    assert judged((size, 0.0), error=error) == [""]


@given(st.floats(3, 30), st.floats(1.3, 3))
def test_a_cause_that_leaves_more_than_a_healthy_arm_does_not(size, over):
    error = over * np.hypot(LARGEST_ERROR, 0.23 * size)
    (why,) = judged((size, 0.0), error=error)
    assert "what a healthy arm may leave on joint_1" in why


@given(st.floats(3, 30), st.floats(0, 2))
def test_what_the_model_closes_by_itself_is_no_merit_of_the_cause(size, ratio):
    """Of effect and change of the model, the effect closes its part of the energy."""
    torque, by_model = LONG[:, 1] * [size, 0.0], LONG[:, 2] * [ratio * size, 0.0]
    left = LONG[:, 0] * [1e-3, 1e-3]
    rows = left + torque + by_model
    gap = HeldOutGap(rows, left, np.zeros(rows.shape), np.ones(2), rms(rows), rms(left), None)
    fit = SimpleNamespace(
        transient=False, keeps_parameters=True, held_out=lambda without=None: left if without is None else left + torque
    )
    assert Adequacy(fit, gap, [None]).closed_alone == pytest.approx(1 / (1 + ratio**2), abs=0.1)


@given(size=st.floats(3, 30), worse=st.floats(1.5, 10))
def test_a_change_of_the_model_that_does_harm_elsewhere_takes_nothing_from_a_cause(size, worse):
    """With the model's change motion of the second joint is predicted worse, so all in all nothing is closed."""
    torque, of_model = LONG[:, 1] * [size, 0.0], LONG[:, 0] * [0.0, worse * size]
    left = LONG[:, 0] * [1e-3, 0.0] + of_model
    rows = LONG[:, 0] * [1e-3, size] + torque
    gap = HeldOutGap(rows, left, np.zeros(rows.shape), np.ones(2), rms(rows), rms(left), None)
    fit = SimpleNamespace(
        transient=False, keeps_parameters=True, held_out=lambda without=None: left if without is None else left + torque
    )
    adequacy = Adequacy(fit, gap, [None])
    assert adequacy.explained_part == max(gap.closure, adequacy.closed_alone)
    assert adequacy.explained_part > 0 > gap.closure


@given(st.floats(2, 20), st.floats(0, 50))
def test_a_cause_is_not_rejected_for_what_the_model_closes_by_itself(size, by_model):
    """A model of few motions errs by more than a small effect on others, within its uncertainty."""
    assert judged((size, 0.0), by_model=by_model) == [""]


@pytest.mark.parametrize(("before", "after", "expected"), [(3.0, 2.1, True), (3.0, 1.9, False), (1.9, 3.0, False)])
def test_a_joint_errs_by_more_than_the_model_as_given_and_with_its_parameters_moved(before, after, expected):
    """What two motions teach may be wrong on a third."""
    raw, left = LONG[:, 0] * [before, 1.0], LONG[:, 0] * [after, 1.0]
    raw, left = (rows / rms(rows) * [size, 1.0] for rows, size in ((raw, before), (left, after)))
    fit = SimpleNamespace(near_rest=np.zeros(left.shape, dtype=bool), sigma=np.ones(left.shape))
    gap = HeldOutGap(raw, left, np.zeros(left.shape), np.ones(2), rms(raw), rms(left), None)
    assert Adequacy(fit, gap).exceeds() is expected
    still = SimpleNamespace(**{**vars(fit), "near_rest": ~fit.near_rest})
    assert not Adequacy(still, gap).exceeds(), "nothing moves"


def test_a_remainder_does_not_count_for_a_cause_that_nothing_smooth_could_replace():
    torque, left, causes = [LONG[:, 1] * [9.0, 0.0]], LONG[:, 0] * [4.0, 1.0], [SimpleNamespace(joints=(0,))]
    assert "on joint_1" in reasons(left + torque[0], left, torque, causes)[0]
    assert reasons(left + torque[0], left, torque, causes, irreplaceable=True) == [""]


def test_a_cause_is_judged_on_its_own_joint_though_another_one_feels_it_more():
    """An elastic gear shows on its neighbours too."""
    torque, left = LONG[:, 1] * [3.0, 9.0], LONG[:, 0] * [3.0, 0.5]
    assert "on joint_1" in reasons(left + torque, left, [torque], [SimpleNamespace(joints=(0,), blocks=(0, 1))])[0]
    assert reasons(left + torque, left, [torque], [SimpleNamespace(joints=(), blocks=(0, 1))]) == [""]


@given(st.floats(3, 20), st.floats(0.1, 0.8))
def test_one_cause_alone_cancels_with_no_other(size, against):
    """Numbers of a simulator that move trade with it: they take back a part of what it explains."""
    assert judged((size, 0.0), against=against) == [""]


def test_causes_that_cancel_each_other_are_no_explanation():
    rng = np.random.default_rng(1)
    large, rest = 20 * rng.normal(size=4000), 5 * LONG[:, 2, 0]
    torque = [np.column_stack([large, 0 * large]), np.column_stack([rest - large, 0 * large])]
    found = reasons(LONG[:, 0] + sum(torque), LONG[:, 0], torque, [SimpleNamespace(joints=(0,))] * 2)
    assert all("cancel" in why for why in found)


@given(st.floats(2, 20), st.floats(0.5, 1.2))
def test_a_cause_that_fails_does_not_take_one_of_another_joint_with_it(size, error):
    """The first joint is explained, on the second one half of the torque stays."""
    assert judged((size, 0.0), (0.0, size), error=np.array([error, 2 + 0.6 * size]))[0] == ""


@pytest.fixture(scope="module")
def case():
    """A small arm whose gear rubs under load, and its model."""
    arm = make_arm("RRR")
    effect = {"effect": "load_dependent_friction", "joints": ["joint_3"], "parameters": {"coefficient": 0.15}}
    plant = Plant(arm, seed=3, effects=[effect])
    logs = [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]
    return assemble(arm, learn(arm), logs, None)


def test_on_an_arm_the_right_cause_passes_and_a_relative_of_it_does_not(case):
    found = {}
    for name in ("load_dependent_friction", "friction_change"):
        effect = CATALOGUE[name]
        forms = case.fit.candidates([(effect, (2,), s) for s in effect.settings(case.fit, (2,))])
        fits = [case.fit.with_chosen([form]) for form in forms]
        best = min(fits, key=lambda fit: fit.error)
        gap = held_out_gap(case, best)
        (why,) = Adequacy(best, gap, best.chosen).shortfalls(lambda number: False)
        found[name] = why, list(remainders(case, gap))
    assert found["load_dependent_friction"] == ("", [])
    why, (left,) = found["friction_change"]
    assert why
    assert (left.joint, left.size > 1) == ("joint_3", True)
    assert max(left.follows.values()) <= 1
    assert Adequacy(case.fit, held_out_gap(case, case.fit)).remainder_sizes[2] > left.size


def best_form(dataset, effect: str, *others):
    """The form of an effect on the last joint that leaves least, next to other forms."""
    effect = CATALOGUE[effect]
    forms = dataset.fit.candidates([(effect, (2,), settings) for settings in effect.settings(dataset.fit, (2,))])
    return min(forms, key=lambda form: dataset.fit.with_chosen((form, *others)).error)


def test_a_cause_that_the_others_replace_in_another_form_is_not_needed(case):
    """Friction by load, in a poor form next to a level of its own: its best form needs none."""
    right, level = best_form(case, "load_dependent_friction"), best_form(case, "friction_change")
    poor = case.fit.candidate(right.effect, (2,), {**right.settings, "reversal_travel": 0.3})
    alone, pair = (Hypothesis(forms, (), 9.0, {}, (0.1,) * len(forms), 1.0, 1.0) for forms in ((right,), (poor, level)))
    both = SelectedCauses(
        case.fit, case.fit.with_chosen((poor, level)), (poor, level), ((), ()), (0.9, 0.9), 1.0, (pair, alone), None
    )
    fewer = drop_replaceable(both, Adequacy.of(both, held_out_gap(case, both.fit)))
    assert fewer.causes == (right,)
    assert drop_replaceable(fewer, Adequacy.of(fewer, held_out_gap(case, fewer.fit))) is None


@pytest.mark.parametrize(
    ("effect", "joints", "expected"),
    [
        ("torque_ripple", (1,), True),
        ("gravity_spring", (1,), False),
        ("torque_constant", (1,), False),
        ("wrist_coupling", (1, 2), False),
    ],
)
def test_only_what_is_in_the_gear_of_one_joint_may_leave_more(effect, joints, expected):
    cause = SimpleNamespace(effect=CATALOGUE[effect], joints=joints)
    evidence = SimpleNamespace(pool=SimpleNamespace(numbers=len), irreplaceable=lambda numbers, number: True)
    selected = SelectedCauses(None, None, (cause,), ((),), (0.9,), 1.0, (), evidence)
    assert selected.irreplaceable(0) is expected


def irreplaceable(dataset, effect: str, joint: int) -> bool:
    """Of the best form of an effect."""
    effect = CATALOGUE[effect]
    forms = dataset.fit.candidates([(effect, (joint,), one) for one in effect.settings(dataset.fit, (joint,))])
    evidence = Evidence(dataset.fit, forms)
    best = max((evidence.evaluate([k]) for k in range(len(forms))), key=lambda one: one.log_evidence)
    return evidence.irreplaceable(best.effects, 0)


def test_a_ripple_is_needed_next_to_anything_smooth_and_the_wrong_law_of_friction_is_not(case):
    ripple = {"effect": "torque_ripple", "joints": ["joint_2"], "parameters": {"amplitude": 4.0, "order": 4.0}}
    plant = Plant(case.robot, seed=3, effects=[ripple])
    logs = [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]
    assert irreplaceable(assemble(case.robot, case.model, logs, None), "torque_ripple", 1)
    assert not irreplaceable(case, "friction_change", 2)


def test_a_right_cause_is_kept_where_the_motion_held_out_goes_further_than_the_fit(case):
    """A spring with two harmonics that was fitted to the smaller of two motions says little about the larger one."""
    arm, effect = case.robot, CATALOGUE["gravity_spring"]
    spring = {"effect": effect.name, "joints": ["joint_2"], "parameters": {"rate": 40.0, "preload": 50.0}}
    plant = Plant(arm, seed=3, effects=[spring])
    logs = [record(plant, name, 23, share) for name, share in (("wide", 1.0), ("narrow", 0.3))]
    dataset = assemble(arm, case.model, logs, None)
    form = dataset.fit.candidate(effect, (1,), {"harmonics": 2.0})
    fit = dataset.fit.with_chosen([form])
    gap = held_out_gap(dataset, fit)
    assert gap.after[1] * gap.unit[1] > 4 * fit.sigma.min(axis=0)[1]
    assert Adequacy(fit, gap, [form]).shortfalls(lambda number: False) == [""]
