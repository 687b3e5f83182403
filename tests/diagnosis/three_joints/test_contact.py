"""Contacts: on any link, several in a log, for any share of it; a force that repeats in every cycle is not one."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from agent.diagnosis import diagnose, simulate
from agent.diagnosis.rows.dataset import assemble
from agent.diagnosis.sizes import intervals
from agent.model.effects import CATALOGUE
from agent.pages import diagnosis_report
from agent.pipeline import GapQuestion
from agent.pipeline.gap.next_steps import after_diagnosis
from agent.robot.dynamics import Dynamics
from fake_controller.plant import Plant
from tests.small_arms import record

FORCE = np.array([25.0, -40.0, 60.0])  # N
CONTACT = CATALOGUE["contact"]


@pytest.fixture(scope="module")
def free(arm):
    plant = Plant(arm, seed=3)
    return [record(plant, name, seed) for name, seed in (("one", 21), ("two", 22))]


def pushed(arm, log, end: str, times, share: float = 1.0, at=(0.0, 0.0, 0.0)):
    """The log with a `share` of a force during `times` [s] at a point [m] from where the link `end` begins."""
    dynamics, step, place = Dynamics(arm), 1e-6, np.append(at, 1.0)
    jacobian = np.stack(
        [
            ((dynamics.link_poses(log.position + d, end) - dynamics.link_poses(log.position - d, end)) @ place)[:, :3]
            / (2 * step)
            for d in step * np.eye(arm.dof)
        ],
        axis=2,
    )
    acts = np.zeros(len(log.t))
    for start, stop in times:
        acts = np.maximum(acts, np.clip(np.minimum(log.t - start, stop - log.t) / 0.05, 0, 1))
    return replace(log, effort=log.effort - acts[:, None] * np.einsum("san,a->sn", jacobian, share * FORCE))


@pytest.mark.verify
def test_a_constant_shift_of_one_log_is_not_a_push(arm, model, free):
    """An offset, a gain or a load of one log only: that log has no usual windows."""
    shift = 15.0 * (np.arange(arm.dof) == 1)
    found = diagnose(arm, [free[0], replace(free[1], effort=free[1].effort + shift)], model).document
    assert found.verdict == "unknown"
    assert found.causes == ()


def best(arm, model, logs):
    fit = assemble(arm, model, logs, None).fit
    wanted = [(CONTACT, (), settings) for settings in CONTACT.settings(fit, ())]
    if not wanted:
        return None
    fits = [fit.with_chosen([form]) for form in fit.candidates(wanted)]
    rows = sum(residual.size for residual in fit.residuals_as_given)

    def criterion(chosen):
        """Of Schwarz: what it leaves, and what its numbers cost."""
        (form,) = chosen.chosen
        return chosen.error + np.log(rows) * (CONTACT.counted(form.settings) + len(form.names))

    found = min(fits, key=criterion)
    (form,), (values,) = found.chosen, found.values
    return CONTACT.reported(fit.reference, form.settings, dict(zip(form.names, values, strict=True)))


def forces(found):
    """Link, log, start, end and force of each push, by its start."""
    ends = [""] + [f"_{number}" for number in range(2, 40)]
    return sorted(
        (
            *(found[f"{key}{suffix}"] for key in ("start", "end", "link", "log")),
            np.array([found[f"force_{axis}{suffix}"] for axis in "xyz"]),
        )
        for suffix in ends
        if f"link{suffix}" in found
    )


def are_found(found, expected, link=2, most=0.25):
    """Pushes with the expected (start, end, log), in this order, with the force that was used, on a link or where the
    next one begins."""
    assert [entry[3] for entry in found] == [log for *_, log in expected]
    assert {entry[2] for entry in found} <= {link, link + 1}
    for (start, end, *_, force), (begins, ends, _) in zip(found, expected, strict=True):
        assert (start, end) == pytest.approx((begins, ends), abs=0.2)
        assert np.linalg.norm(force - FORCE) < most * np.linalg.norm(FORCE)
    return True


@pytest.mark.verify
@pytest.mark.parametrize("shape", ["as it rises", "as it falls"])
def test_a_strong_push_is_named_whatever_its_shape(arm, model, free, shape):
    """It explains all that it leaves: a force that jumps, then fades, is not one that is constant."""
    log = pushed(arm, free[0], "link_3", [(2.0, 3.2)], 4.0)
    over = np.clip((log.t - 2.0) / 1.2, 0.0, 1.0)
    share = over if shape == "as it rises" else 1.0 - over
    log = replace(log, effort=free[0].effort + share[:, None] * (log.effort - free[0].effort))
    result = diagnose(arm, [log, free[1]], model).document
    assert (result.verdict, [cause.effect for cause in result.causes]) == ("explained", ["contact"])
    force = np.array([result.causes[0].parameters[f"force_{axis}"] for axis in "xyz"])
    assert np.linalg.norm(force - 4.0 * FORCE) < 0.25 * np.linalg.norm(4.0 * FORCE)


@pytest.mark.parametrize("times", [[(2.0, 2.6)], [(1.2, 2.0), (6.9, 7.5)], [(1.0, 7.0)], [(1.22, 2.78), (8.0, 9.56)]])
def test_pushes_are_found_on_their_link_with_force_and_times(arm, model, free, times):
    found = forces(best(arm, model, [pushed(arm, free[0], "link_3", times), free[1]]))
    assert are_found(found, [(*time, 0) for time in times])


@pytest.mark.verify
def test_many_pushes_are_found(arm, model):
    """As on an arm that was hit eighteen times in a minute and a half."""
    plant, times = Plant(arm, seed=3), [(1.2, 2.0), (6.9, 7.5)]
    logs = [record(plant, f"{seed}", seed) for seed in range(21, 26)]
    found = forces(best(arm, model, [pushed(arm, log, "link_3", times) for log in logs[:4]] + logs[4:]))
    assert {(log, round(start)) for start, _, _, log, _ in found} == {(log, at) for log in range(4) for at in (1, 7)}


@pytest.mark.verify
def test_a_push_in_the_middle_of_a_link_is_found_there(arm, model, free):
    """`link_3` begins at the third joint, which feels a force elsewhere on it, and at its far end another one."""
    place, times = (0.1, 0.0, 0.1), [(1.2, 2.0), (6.9, 7.5)]
    logs = [pushed(arm, free[0], "link_3", times, at=place), free[1]]
    found = best(arm, model, logs)
    assert are_found(forces(found), [(*time, 0) for time in times], 3, 0.35), "three joints, for force and place"
    (cause,) = diagnose(arm, logs, model).result["causes"]
    assert (cause["effect"], cause["parameters"]["link"]) == ("contact", 3)
    assert cause["closure"] > 0.97


def test_finds_a_push_that_began_before_the_log(arm, model, free):
    """There is no quiet time before it, so it has to exceed the time after it by far."""
    found = forces(best(arm, model, [pushed(arm, free[0], "link_3", [(-1.0, 1.6)]), free[1]]))
    assert found[0][0] < 0.4
    assert are_found(found, [(found[0][0], 1.6, 0)])


def test_finds_several_long_pushes_in_every_log(arm, model, free):
    """One of them meets the phase of another in the next cycle; all bias the model's numbers if these may move."""
    times = [(1.0, 3.0), (6.6, 8.6)]
    found = forces(best(arm, model, [pushed(arm, log, "link_3", times) for log in free]))
    found = sorted(found, key=lambda entry: (round(entry[0]), entry[3]))
    assert are_found(found, [(*time, log) for time in times for log in (0, 1)])


@pytest.mark.parametrize("times", [[], [(1.5, 2.2), (6.5, 7.2)]])
def test_finds_no_push_without_one_or_if_every_cycle_repeats_it(arm, model, free, times):
    found = best(arm, model, [pushed(arm, free[0], "link_3", times), free[1]])
    assert found is None or all(np.linalg.norm(entry[-1]) < 0.05 * np.linalg.norm(FORCE) for entry in forces(found))


def test_drifting_friction_is_not_a_series_of_pushes(arm, model, free):
    since = np.exp(-free[0].t / 3.0)[:, None] * np.array([0.0, 8.0, 0.0])
    drifting = replace(free[0], effort=free[0].effort + since * np.sign(free[0].velocity))
    found = best(arm, model, [drifting, free[1]])
    assert found is None or len(forces(found)) == 1, "the strongest stroke at most"


def test_a_force_over_the_whole_log_is_not_a_push(arm, model, free):
    """No other window shows the usual gain."""
    always = [(free[0].t[0] - 1, free[0].t[-1] + 1)]
    found = best(arm, model, [pushed(arm, free[0], "link_3", always)])
    within = 0.0 if found is None else sum(end - start for start, end, *_ in forces(found))
    assert within < 0.8 * free[0].t[-1]


def test_finds_a_push_near_the_base_with_a_stronger_one_at_the_tip(arm, model, free):
    """Joints near the base are known less finely: a force there gains a twenty-fifth of what the other does."""
    tip, base = (1.2, 2.0), (6.0, 6.8)
    log = pushed(arm, pushed(arm, free[0], "link_3", [tip]), "link_2", [base], share=0.6)
    found = forces(best(arm, model, [log, free[1]]))
    assert [entry[:2] for entry in found] == [pytest.approx(tip, abs=0.2), pytest.approx(base, abs=0.2)]


def test_the_page_lists_each_push_with_point_times_and_force(arm, model, free):
    times = [(1.2, 2.0), (6.9, 7.5)]
    found = diagnose(arm, [pushed(arm, free[0], "link_3", times), free[1]], model)
    assert [cause["effect"] for cause in found.result["causes"]] == ["contact"]
    (known,) = intervals(found.selected)
    for axis, force in zip("xyz", FORCE, strict=True):
        low, high = known[f"force_{axis}"]
        assert high - low < np.linalg.norm(FORCE), "a fold of motions that holds all of a push says nothing of it"
        assert (low + high) / 2 == pytest.approx(force, abs=0.3 * np.linalg.norm(FORCE))
    assert not {"link", "log", "start", "end"} & set(known)
    page = diagnosis_report(found, [])
    rows = re.findall(r"<tr>((?:(?!</tr>).)*one\.mcap</td>)</tr>", page)
    assert [row[:11] for row in rows] == ["<td>1</td><", "<td>2</td><"]
    assert all(len(re.findall(r"[0-9] ± [0-9.]+ N<", row)) == 3 for row in rows)


def test_a_push_is_not_taken_into_the_model():
    result = {"verdict": "explained", "causes": [{"effect": "contact"}], "next_experiment": None}
    (step,) = after_diagnosis(result, None, [Path("a.mcap")], GapQuestion(Path("model.json")))
    assert "not added to a model" in step.what
    assert not step.command


def test_simulates_a_push_that_only_one_log_has(arm, model, free):
    found = diagnose(arm, [pushed(arm, free[0], "link_3", [(1.2, 2.0)]), free[1]], model)
    assert [cause["effect"] for cause in found.result["causes"]] == ["contact"]
    simulated = next(one for one in simulate(found) if one.log == "one.mcap")
    before, after = (np.sqrt(np.mean(part**2)) for part in (simulated.torque_before, simulated.torque_after))
    assert after < 0.5 * before
