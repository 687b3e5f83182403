"""Words for a result with causes of one effect on several joints."""

import pytest

from agent.pages import headline, summary
from agent.pipeline.gap.printed_diagnosis import diagnosis_text


def cause(effect: str, *joints: str, **parameters: float) -> dict:
    return {
        "effect": effect,
        "joints": list(joints),
        "probability": 0.95,
        "closure": 0.3,
        "parameters": parameters,
        "equivalent_to": [],
    }


@pytest.fixture
def result() -> dict:
    rubbing = [cause("friction_change", f"joint_{k}", coulomb_change=0.1 * k) for k in (1, 2, 3)]
    names = ["joint_1", "joint_2", "joint_3"]
    gap = {"joints": names, "units": ["N·m"] * 3, "before": [1.0] * 3, "after": [0.1] * 3, "floor": None}
    return {
        "verdict": "explained",
        "causes": [*rubbing, cause("torque_offset", "joint_2", torque_offset=0.5)],
        "gap": gap,
        "closure": 0.9,
        "where": [{"joint": name, "share": 0.33, "interval": None, "regimes": []} for name in names],
        "next_experiment": None,
        "not_testable": [],
    }


def test_causes_of_one_effect_are_one_sentence_with_the_size_on_each_joint(result):
    said = headline(result)
    assert said.count("(friction_change)") == 2, "the first cause, and all the others"
    assert "Also on joint_2 and joint_3: " in said
    what = summary(result)["what"]
    assert "Also on joint_2 (about +0.2 N·m) and joint_3 (about +0.3 N·m): " in what
    assert "Also on joint_2: " in what, "another effect keeps its sentence"


def test_the_same_look_is_asked_for_once(result):
    steps = summary(result)["next"]
    assert [step.partition(",")[0] for step in steps[1:]] == ["On joint_2 and joint_3", "On joint_2"]


@pytest.mark.parametrize("joints", [[], ["joint_1"], ["joint_1", "joint_3"]])
def test_an_explanation_says_on_which_joints_something_else_is_left(result, joints):
    result["remainder"] = [{"joint": name, "size": 2.4, "regimes": [], "follows": {"time": 0.1}} for name in joints]
    exception = f", but for what is left on {' and '.join(joints)}" if joints else ""
    assert diagnosis_text(result).startswith(f"Verdict   explained{exception}\n")
    assert (f"Explained{exception}." in headline(result)) is bool(joints)
