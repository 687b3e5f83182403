"""Wear is found on the right axle, warm-up is not mistaken for it, and nothing is found where nothing changed."""

import pytest

from agent.runs.history import History
from agent.runs.trends import FALSE_ALARMS, FEWEST, parameter_trends, watch


def _watch(logs):
    history = History(logs)
    (one,) = watch(history.runs())
    return one, parameter_trends(one.figures, history.parameters())


@pytest.mark.parametrize("cooling", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_wear_of_one_axle_is_distinguished_from_warm_up_of_all(write_runs, seed: int, cooling: bool):
    one, parameters = _watch(write_runs(20, seed, wear=seed, cooling=cooling))
    assert [trend.joint for trend in one.alarms] == [f"joint_{seed + 1}"]
    (alarm,) = one.alarms
    assert 0.05 < alarm.change < 0.15
    assert f"joint_{seed + 1}" in alarm.text()
    moving = {trend.name for trend in parameters if trend.kind != "none"}
    assert f"f0_{seed + 1}" in moving or cooling, "a parameter alone cannot tell wear from a warm-up along with time"
    assert not any(name.startswith("p") for name in moving), "what is kept from run to run has no course"


@pytest.mark.parametrize("cooling", [False, True])
def test_no_alarm_without_drift(write_runs, cooling: bool):
    for seed in range(8):
        one, _ = _watch(write_runs(20, seed + (100 if cooling else 0), cooling=cooling))
        assert one.alarms == ()
        assert one.warnings == ()


def test_a_step_is_dated(write_runs):
    def relubricate(number, result):
        for level in result["conditions"]["friction"]:
            if number >= 12 and level["joint"] == "joint_3":
                level["value"] *= 0.9

    one, _ = _watch(write_runs(20, 5, relubricate))
    (alarm,) = one.alarms
    assert (alarm.joint, alarm.kind) == ("joint_3", "step")
    assert alarm.since.startswith("20260112"), "the twelfth run was the last before the step"
    assert alarm.change == pytest.approx(-0.1, abs=0.02)


def test_warns_before_a_limit_is_reached(write_runs):
    def grow(number, result):
        result["validation"]["normalised_rmse"][1] += 0.001 * number  # 0.3 % to 2.2 %; the gate is at 3 %

    def wear(number, result):
        for level in result["conditions"]["friction"][2:4]:
            level["value"] += 0.5 * number  # 9.5 N·m; the gate is at 15 N·m

    for seed, change, text in ((3, grow, "the gate of 3 %"), (4, wear, "friction will have changed by 15 N·m")):
        one, _ = _watch(write_runs(20, seed, change))
        (warning,) = one.warnings
        assert warning.joint == "joint_2"
        assert 4 < warning.days < 16
        assert text in warning.text


def test_the_false_alarm_rate_is_shared_by_all_series(write_runs):
    """Small wear of many sizes: what would be no chance in one series alone is no alarm among twelve."""
    trends = [
        trend
        for seed in range(24)
        for trend in _watch(write_runs(12, 300 + seed, wear=seed % 6, wear_by=0.01 + 0.002 * (seed // 3)))[0].trends
    ]
    share = FALSE_ALARMS / 12
    doubtful = [trend for trend in trends if share < trend.probability < FALSE_ALARMS]
    assert doubtful, "some have to be between the two levels"
    assert all(trend.kind == "none" for trend in doubtful)
    assert all(trend.kind != "none" for trend in trends if trend.probability < share)


def test_few_runs_raise_no_alarm(write_runs):
    history = History(write_runs(FEWEST - 1))
    assert watch(history.runs()) == []


def test_an_arm_with_two_axles_uses_warm_up_within_its_runs(write_runs):
    def two_axles(_, result):
        keep = ("joint_1", "joint_2")
        result["validation"] = {"joints": list(keep), "normalised_rmse": result["validation"]["normalised_rmse"][:2]}
        met = result["conditions"]
        met["friction"] = [level for level in met["friction"] if level["joint"] in keep]
        met["warm_up"] = {key: values[:2] for key, values in met["warm_up"].items()}
        met["nominal_torque"] = met["nominal_torque"][:2]

    one, _ = _watch(write_runs(20, 8, two_axles, wear=0, wear_by=0.2, warm_up=0.02))
    assert [trend.joint for trend in one.alarms] == ["joint_1"]
    one, _ = _watch(write_runs(20, 9, two_axles))
    assert one.alarms == ()


@pytest.mark.verify
@pytest.mark.parametrize("cooling", [False, True])
def test_rates_of_false_alarms_and_detections(write_runs, measured, cooling: bool):
    """Twenty runs each, warm-up of up to 5 % on all axles, wear of 10 % on one or on none."""
    false_alarms = found = wrong = 0
    histories = 100
    for seed in range(histories):
        one, _ = _watch(write_runs(20, 10_000 + seed, cooling=cooling))
        false_alarms += bool(one.alarms)
        one, _ = _watch(write_runs(20, 20_000 + seed, wear=seed % 6, cooling=cooling))
        joints = [trend.joint for trend in one.alarms]
        found += joints == [f"joint_{seed % 6 + 1}"]
        wrong += any(joint != f"joint_{seed % 6 + 1}" for joint in joints)
    case = "simulated histories, " + ("warm-up along with time" if cooling else "warm-up at random")
    measured(f"{case}: alarms without wear", 100 * false_alarms / histories, "%", "at most 1 %", false_alarms <= 1)
    measured(f"{case}: wear found on its axle alone", 100 * found / histories, "%", "at least 90 %", found >= 90)
    measured(f"{case}: alarm on another axle", 100 * wrong / histories, "%", "at most 2 %", wrong <= 2)
    assert false_alarms <= 1
    assert found >= 90
    assert wrong <= 2
