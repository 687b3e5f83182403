"""Effects by other laws than the fitted ones, added to what a healthy arm measured: how far the forms follow them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import savgol_filter

from agent.diagnosis import Candidate, diagnose
from agent.diagnosis.hypotheses.evidence import Evidence
from agent.diagnosis.rows.dataset import assemble
from agent.model import CATALOGUE, IdentifiedModel
from agent.model.friction_terms import dahl
from agent.pipeline.gap.printed_diagnosis import diagnosis_text
from agent.recording.log import Log
from fake_controller.plant import Plant
from tests.small_arms import learn, make_arm, record

JOINT = 2
#: (positions (S,), torque of the bodies (S,), distance travelled before (float)) -> torque (S,) of the law
Law = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


@pytest.fixture(scope="module")
def healthy(arm) -> list[Log]:
    """Three motions of the arm as the model has it; the last goes further than the others."""
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed, share) for name, seed, share in (("a", 21, 1), ("b", 22, 1), ("c", 23, 1.6))]


@pytest.fixture(scope="module")
def size(healthy) -> float:
    """Torque of the joint that laws are added to [N·m], standard deviation."""
    return float(np.std(healthy[0].effort[:, JOINT]))


@pytest.fixture(scope="module")
def left(arm, model, healthy) -> Callable[[str, Law], float]:
    """Part of the law's torque, squared, that the best possible form of an effect leaves held out."""

    def measure(name: str, law: Law) -> float:
        fit = assemble(arm, model, _with(model, healthy, law), None).fit
        effect, place = CATALOGUE[name], (JOINT,)
        wanted = [(effect, place, settings) for settings in effect.settings(fit, place)]
        evidence = Evidence(fit, fit.candidates(wanted), healthy=())
        best = _best(evidence)
        later = [(effect, place, settings) for settings in effect.reversing(fit, place, best.settings)]
        evidence.pool.add(fit.candidates(later))
        best = _best(evidence)
        for factor in (1.25, 1.1, 1.04):
            finer = [(effect, place, near) for near in effect.nearby(best.settings, factor)]
            evidence.pool.add(fit.candidates(finer))
            best = _best(evidence)
        background = float(fit.count.sum()) / len(fit.rows)  # of one joint
        return (fit.with_chosen([best]).error - 3 * background) / (fit.error - 3 * background)

    return measure


def _best(evidence: Evidence) -> Candidate:
    gains, _ = evidence.shortlist_gains(evidence.as_expected(evidence.null_hypothesis))
    return evidence.pool.candidate(int(np.argmax(gains)))


def _bristles(position: np.ndarray, level: float, stiffness: float) -> np.ndarray:
    """Torque (S,) of bristles that slide at a level: LuGre without its damping, exact over a step."""
    torque = np.zeros(len(position))
    for k, step in enumerate(np.diff(position), 1):
        slides = np.sign(step) * level
        torque[k] = slides + (torque[k - 1] - slides) * np.exp(-abs(step) * stiffness / level)
    return torque


@pytest.mark.verify
@pytest.mark.parametrize("level", [3.0, 8.0])
def test_bristles_that_are_not_those_of_the_form_are_unknown_where_the_joint_reverses(arm, model, healthy, level):
    """Friction with a longer reversal distance: presliding as it is known leaves a fifth of it."""
    travel = 4e-3  # rad over which the friction that is there before reverses

    def law(q, load, gone):
        return _bristles(q, level, level / travel / 3.0) - _bristles(q, level, level / travel)

    found = diagnose(arm, _with(model, healthy[:2], law, joint=1), model).document
    assert (found.verdict, found.causes) == ("unknown", ())
    (remainder,) = found.remainder
    assert (remainder.joint, remainder.regimes[0].name) == ("joint_2", "reversal"), "where it lies is said"


@pytest.mark.verify
def test_names_a_small_effect_next_to_a_much_larger_one(arm, model, healthy):
    """The spring takes all but a hundredth of the gap; on the first joint there is nothing but viscous friction."""
    size = [np.std(healthy[0].effort[:, joint]) for joint in range(2)]
    spring, more = 2.0 * size[1], 0.1 * size[0] / np.std(healthy[0].velocity[:, 0])
    logs = []
    for log in healthy:
        effort = log.effort.copy()
        effort[:, 1] += spring * np.sin(log.position[:, 1] - 0.3)
        effort[:, 0] += more * log.velocity[:, 0]
        logs.append(replace(log, effort=effort))
    found = diagnose(arm, logs, model).document
    causes = {(cause.effect, cause.joints): cause for cause in found.causes}
    assert set(causes) == {("gravity_spring", ("joint_2",)), ("friction_change", ("joint_1",))}
    small = causes["friction_change", ("joint_1",)]
    assert small.closure < 0.03
    assert small.closure_of_joints > 0.9
    assert small.parameters["viscous_change"] == pytest.approx(more, rel=0.1)


def test_a_torsion_spring_may_be_equivalent_to_a_hose(arm, model, healthy):
    """A hose that neither hardens nor rubs is the same straight line."""
    stiffness = 0.5 * np.std(healthy[0].effort[:, JOINT])
    found = diagnose(arm, _with(model, healthy, lambda q, load, gone: stiffness * (q - 0.4)), model).document
    (cause,) = found.causes
    assert (found.verdict, cause.effect, cause.joints) == ("ambiguous", "gravity_spring", ("joint_3",))
    assert [place.effect for place in cause.equivalent_to] == ["dress_pack"]
    assert cause.parameters["stiffness"] == pytest.approx(stiffness, rel=0.05)
    assert cause.parameters["constant"] == pytest.approx(-0.4 * stiffness, rel=0.2)


@pytest.mark.verify
def test_a_nearly_constant_spring_is_not_an_offset(arm, model, healthy, size):
    """About where it pulls most it is a constant but for a hundredth, which is clear of what the model gets wrong."""
    travelled = np.concatenate([log.position[:, JOINT] for log in healthy])
    middle, reach = travelled.mean(), np.ptp(travelled) / 2
    altered = _with(model, healthy, lambda q, load, gone: 4 * size * np.cos(0.8 * (q - middle - 0.1) / reach))
    (cause,) = diagnose(arm, altered, model).document.causes
    named = {place.effect for place in (cause, *cause.equivalent_to)}
    assert "gravity_spring" in named
    assert "torque_offset" not in named


@pytest.mark.verify
def test_friction_that_bends_by_little_is_not_ruled_out(arm, model, healthy, size):
    """Another level explains all but two hundredths, and no form is trusted further; but that is there all the same."""
    logs = []
    for log in healthy:
        effort, speed = log.effort.copy(), log.velocity[:, JOINT]
        fast = 0.25 * np.abs(speed).max()
        effort[:, JOINT] += size * fast * np.arcsinh(speed / fast)
        logs.append(replace(log, effort=effort))
    found = diagnose(arm, logs, model).document
    named = {place.effect for cause in found.causes for place in (cause, *cause.equivalent_to)}
    assert "viscous_nonlinearity" in named


@pytest.mark.verify
def test_friction_that_grows_with_a_load_that_hardly_changes_is_not_ruled_out(arm, model):
    """As many parameters explain more, by as little as the load changes; another level of friction is no simpler."""
    plant = Plant(arm, seed=3)
    logs = [record(plant, name, seed, 0.1) for name, seed in (("a", 21), ("b", 22), ("c", 23))]
    altered = _with(model, logs, lambda q, load, gone: 0.05 * np.abs(load) * _slide(q), joint=1)
    found = diagnose(arm, altered, model).document
    named = {(place.effect, place.joints) for cause in found.causes for place in (cause, *cause.equivalent_to)}
    assert ("load_dependent_friction", ("joint_2",)) in named
    assert found.verdict == "ambiguous"


@pytest.mark.verify
@pytest.mark.parametrize(
    ("law", "causes", "named", "verdict"),
    [
        pytest.param(
            lambda q: np.sin(q - 0.4) + 0.5 * dahl(q, np.array([1e-3]))[:, 0],
            *(None, {"gravity_spring"}, None),
            id="that turns around at once",
        ),
        pytest.param(
            lambda q: np.sin(q - 0.4) + 0.4 * _slide(q),
            *(None, {"gravity_spring", "dress_pack"}, "ambiguous"),
            id="or a spring",
        ),
        pytest.param(
            lambda q: 10 + 0.6 * (q - 0.4) + 0.5 * dahl(q, np.array([0.1]))[:, 0],
            *(["dress_pack"], set(), "explained"),
            id="and a large constant",
        ),
        pytest.param(
            lambda q: 0.4 + 0.3 * _slide(q),
            *(None, {"friction_change", "torque_offset"}, None),
            id="that does not pull",
        ),
    ],
)
def test_a_hose_with_friction(arm, model, healthy, size, law, causes, named, verdict):
    """Inner friction that turns around at once is the joint's as well, so an offset with friction may be a hose."""
    found = diagnose(arm, _with(model, healthy, lambda q, load, gone: size * law(q)), model).document
    places = {(place.effect, place.joints) for cause in found.causes for place in (cause, *cause.equivalent_to)}
    assert {joints for _, joints in places} == {("joint_3",)}
    assert named <= {name for name, _ in places}
    assert causes in (None, sorted(cause.effect for cause in found.causes))
    assert verdict in (None, found.verdict)
    assert not causes or ("dress_pack" in {name for name, _ in places}) == ("dress_pack" in causes)


@pytest.mark.verify
def test_a_ripple_with_few_periods_is_not_a_hose(arm, model, healthy, size):
    """A curve through six positions follows two and a half periods; their order is between two lines of a spectrum."""
    travel = np.ptp(np.concatenate([log.position[:, JOINT] for log in healthy]))
    order = max(2.5 * 2 * np.pi / travel, 9.0)
    assert order * travel < 3 * 2 * np.pi
    altered = _with(model, healthy, lambda q, load, gone: 0.5 * size * np.cos(order * q - 0.7))
    (cause,) = diagnose(arm, altered, model).document.causes
    assert (cause.effect, cause.joints) == ("torque_ripple", ("joint_3",))
    assert cause.parameters["order"] == pytest.approx(order, rel=0.02)


@pytest.mark.verify
def test_a_spring_between_two_pivots_keeps_its_name(arm, model, healthy, size):
    """The lever is long compared with the anchor, so its law is far from a sine."""

    def law(q, load, gone):
        angle = q + 0.4
        length = np.sqrt(1 + 0.6**2 - 2 * 0.6 * np.cos(angle))
        return size * np.sin(angle) / length

    found = diagnose(arm, _with(model, healthy, law), model).document
    named = {(place.effect, place.joints) for cause in found.causes for place in (cause, *cause.equivalent_to)}
    assert ("gravity_spring", ("joint_3",)) in named
    assert found.closure > 0.997


def test_load_dependent_friction_grows_with_link_torque_not_rotor_torque(arm, model, healthy):
    """A small axis spends most of its torque on its own rotor, and its gear transmits none of that."""
    joints = tuple(replace(joint, rotor_inertia=0.02) for joint in arm.joints)
    arm = replace(arm, joints=joints)
    model = learn(arm)
    plant = Plant(arm, seed=3)
    logs = [record(plant, name, seed) for name, seed in (("a", 21), ("b", 22))]
    fit = assemble(arm, model, logs, None).fit
    carried = [signals.link_load[:, JOINT] for signals in fit.signals]
    assert np.std(np.concatenate(carried)) < 0.5 * np.std(np.concatenate([s.rigid[:, JOINT] for s in fit.signals]))
    altered = []
    for log, signals, load in zip(logs, fit.signals, carried, strict=True):
        more = np.interp(log.t, signals.time, 1.0 * np.abs(load) * signals.direction(JOINT))
        effort = log.effort.copy()
        effort[:, JOINT] += more
        altered.append(replace(log, effort=effort))
    (cause,) = diagnose(arm, altered, model).document.causes
    assert (cause.effect, cause.joints) == ("load_dependent_friction", ("joint_3",))
    assert cause.parameters["coefficient"] == pytest.approx(1.0, rel=0.15)


@pytest.mark.verify
def test_names_a_spring_on_a_prismatic_joint():
    arm = make_arm("RPR")
    model, plant = learn(arm), Plant(arm, seed=3)
    logs = []
    for name, seed in (("a", 21), ("b", 22)):
        log = record(plant, name, seed)
        effort = log.effort.copy()
        effort[:, 1] += np.std(effort[:, 1]) * log.position[:, 1]
        logs.append(replace(log, effort=effort))
    found = diagnose(arm, logs, model).document
    assert [(cause.effect, cause.joints) for cause in found.causes] == [("gravity_spring", ("joint_2",))]
    lines = [line for line in diagnosis_text(found.to_dict()).splitlines() if "stiffness" in line]
    assert lines
    assert all(" N/m" in line and "N·m" not in line for line in lines)


def _with(model: IdentifiedModel, logs: Sequence[Log], law: Law, joint: int = JOINT) -> list[Log]:
    gone, found = 0.0, []
    for log in logs:
        q, effort = log.position[:, joint], log.effort.copy()
        qdd = np.gradient(savgol_filter(log.velocity, 25, 2, axis=0), log.t, axis=0)
        load = model.rigid.torque(log.position, log.velocity, qdd, model.base_values)
        effort[:, joint] += law(q, load[:, joint], gone)
        gone += float(np.abs(np.diff(q)).sum())
        found.append(replace(log, effort=effort))
    return found


def _slide(q: np.ndarray) -> np.ndarray:
    return dahl(q, np.array([2e-3]))[:, 0]


def _hose(power: float, slack: float, rubs_over: float) -> Law:
    def law(q: np.ndarray, load: np.ndarray, gone: float) -> np.ndarray:
        hardens = np.sign(q - 0.05) * np.maximum(np.abs(q - 0.05) - slack, 0) ** power
        return 40 * hardens + 4 * dahl(q, np.array([rubs_over]))[:, 0]

    return law


def _warming(q: np.ndarray, load: np.ndarray, gone: float) -> np.ndarray:
    return 4 * np.exp(-(gone + np.cumsum(np.abs(np.diff(q, prepend=q[0])))) / 5) * _slide(q)


def _back_driven(q: np.ndarray, load: np.ndarray, gone: float) -> np.ndarray:
    return np.where(load * np.gradient(q) > 0, 0.15, 0.05) * np.abs(load) * _slide(q)


def _thinning(q: np.ndarray, load: np.ndarray, gone: float) -> np.ndarray:
    speed = np.gradient(q, 0.002)
    return 12 * speed / (1 + (speed / 0.02) ** 2) ** 0.25


@pytest.mark.parametrize(
    ("effect", "law", "most"),
    [
        *(("dress_pack", _hose(*form), 0.03) for form in ((1, 0.0, 0.05), (2, 0.2, 0.005), (3, 0.1, 0.001))),
        ("thermal_friction", _warming, 0.05),  # with the distance over all logs
        ("load_dependent_friction", lambda q, load, gone: 3 * _slide(q) * (np.abs(load) / 20) ** 0.5, 0.1),
        ("load_dependent_friction", lambda q, load, gone: 3 * _slide(q) * (np.abs(load) / 20), 0.1),
        ("load_dependent_friction", lambda q, load, gone: 3 * _slide(q) * (np.abs(load) / 20) ** 2, 0.1),
        ("load_dependent_friction", _back_driven, 0.15),  # with a lower loss
        ("viscous_nonlinearity", _thinning, 0.05),
    ],
)
def test_a_form_follows_a_law_that_it_was_not_made_for(left, effect, law, most):
    assert left(effect, law) < most


def test_an_exactly_stationary_joint_gives_finite_columns(arm, model, healthy):
    stands = [replace(log, position=np.repeat(log.position[:1], len(log.t), axis=0), velocity=None) for log in healthy]
    fit = assemble(arm, model, [healthy[0], *stands[1:]], None).fit
    for effect in CATALOGUE.values():
        wanted = [
            (effect, place, settings)
            for place in effect.possible_joints(arm)
            for settings in effect.settings(fit, place)
        ]
        found = fit.candidates(wanted[-40:])
        assert all(np.isfinite(block).all() for one in found for block in one.blocks.values()), effect.name


@pytest.mark.parametrize("offset", [0.15, -0.6])
def test_a_zero_that_is_far_off_is_no_spring_and_no_load(arm, model, offset):
    """Gravity bends over such an offset, so its torque is no multiple of the slope at zero."""
    effect = {"effect": "encoder_offset", "joints": ["joint_2"], "parameters": {"offset": offset}}
    plant = Plant(arm, seed=3, effects=[effect])
    found = diagnose(arm, [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))], model).document
    (cause,) = found.causes
    assert (found.verdict, cause.effect, cause.joints) == ("explained", "encoder_offset", ("joint_2",))
    assert cause.parameters["offset"] == pytest.approx(offset, rel=0.02)
