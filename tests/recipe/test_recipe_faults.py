import contextlib
import math
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

from agent.core import Dimension, InputError
from agent.motion.pdl2.dialect import Pdl2
from agent.recipe import examine_recipe, load_recipe
from agent.robot import load_robot
from tests.recipe.recipes import FULL, MINIMAL, POINTS, TUBE, faults_of, load_text, with_via_points
from tests.recording.test_importer import URDF


@pytest.mark.parametrize(
    ("via_points", "key", "message"),
    [
        ("count: 6", "via_points", "exactly one of"),
        (f"{POINTS}, {TUBE.removeprefix('count: 4, ')}", "via_points", "exactly one of"),
        (f"count: 6, {POINTS}", "via_points.count", "leave count out"),
        (TUBE.removeprefix("count: 4, "), "via_points.count", "required"),
        (f"{TUBE}, around: 5 mm", "via_points.around", "like alone"),
        ("count: 6, like: task.pdl", "via_points.around", "required"),
        ("count: 6, like: absent.pdl, around: 1 cm", "via_points.like", "no such file"),
        (POINTS.replace("[1 cm, 2 cm, 3 cm, 0, 10 deg, 0]", "[0, 0, 0, 0, 0, 0]"), "via_points.points", "no point has"),
        ("count: 6, like: absent.pdl, around: 50", "via_points.around", "did you mean 50 mm?"),
        (TUBE.replace("50 mm", "50"), "via_points.tube.radius", "did you mean 50 mm?"),
        ("count: 6, like: absent.pdl, around: 0 mm", "via_points.around", "0.0001"),
        (TUBE.replace("count: 4", "count: 1"), "via_points.count", "greater than or equal to 2"),
    ],
)
def test_names_conflicting_alternatives(recipe_file: Path, via_points: str, key: str, message: str) -> None:
    fault = faults_of(recipe_file, with_via_points(via_points))[0]
    assert f"recipe.yaml:4: motion.{key}: " in fault
    assert message in fault


@pytest.mark.parametrize(
    ("old", "new", "line", "key", "message"),
    [
        ("search: {population", "search: {populaton", 13, "search.populaton", "did you mean population?"),
        ("speed: 500 mm/s", "speed: 500 mm", 7, "motion.speed", "m/s, cm/s, mm/s"),
        ("speed: 500 mm/s", "speed: 2 m/s", 7, "motion.speed", "1.5 m/s"),
        ("speed: 500 mm/s", "speed: -1 m/s", 7, "motion.speed", "0.001"),
        ("speed: 500 mm/s", "speed: 1e-320 m/s", 7, "motion.speed", "0.001"),
        ("cutoff: 20 Hz", "cutoff: 1e-300 Hz", 15, "estimate.filter.cutoff", "0.1"),
        ("every: 12 h", "every: 1e-300 s", 18, "recalibrate.every", "equal to 1"),
        ("normalised_rmse: 0.05", "normalised_rmse: 1e-300 %", 17, "gate.normalised_rmse", "0.000001"),
        ("speed: 500 mm/s", "speed: .nan", 7, "motion.speed", "finite"),
        ("speed: 500 mm/s", "speed: true", 7, "motion.speed", "not true or false"),
        ("speed: 500 mm/s", "speed:", 7, "motion.speed", "not nothing"),
        ("distance: 30 mm", "distance: 30 deg", 8, "motion.fly.distance", "a unit of an angle"),
        ("type: FLY_NORM", "type: FLY", 8, "motion.fly.type", "'FLY_NORM' or 'FLY_CART'"),
        ("normalised_rmse: 0.05", "normalised_rmse: 0.5", 17, "gate.normalised_rmse", "50 % is hardly meant"),
        ("normalised_rmse: 0.05", "normalised_rmse: 0.5", 17, "gate.normalised_rmse", "did you mean 0.5 %?"),
        ("every: 12 h", "every: 7", 18, "recalibrate.every", "did you mean 7 d?"),
        ("every: 12 h", 'every: "7"', 18, "recalibrate.every", "did you mean 7 d?"),
        ("every: 12 h", "every: 0", 18, "recalibrate.every", "equal to 1"),
        ("cone: 30 deg", "cone: 30", 12, "motion.via_points.box.cone", "did you mean 30 deg?"),
        ("cone: 30 deg", "cone: 2", 12, "motion.via_points.box.cone", "did you mean 2 deg?"),
        ("cone: 30 deg", "cone: 3000", 12, "motion.via_points.box.cone", "write the unit"),
        ("0 deg, 180 deg, 0 deg", "0, 180, 0", 12, "motion.via_points.box.orientation.1", "did you mean 180 deg?"),
        ("[500 mm, 600 mm, 400 mm]", "[500, 1, 1]", 12, "motion.via_points.box.size.0", "did you mean 500 mm?"),
        ("[500 mm, 600 mm, 400 mm]", "[0, 0 mm, 0]", 12, "motion.via_points.box.size", "a box of no size"),
        ("[1.0 m, 0 m, 0.8 m]", "[1000, 0, 0.8]", 12, "motion.via_points.box.centre.0", "did you mean 1000 mm?"),
        ("distance: 30 mm", "distance: 30", 8, "motion.fly.distance", "did you mean 30 mm?"),
        ("speed: 500 mm/s", "speed: 500", 7, "motion.speed", "did you mean 500 mm/s?"),
        ("mass: 2.1 kg", "mass: 2100", 2, "tool.mass", "did you mean 2100 g?"),
        ("120 mm", "120", 2, "tool.frame.2", "did you mean 120 mm?"),
        ("rate: 250 Hz", "rate: 0.25", 14, "record.rate", "did you mean 0.25 kHz?"),
        ("[-90 deg, 2]", "[-90, 2]", 5, "cell.joint_ranges.joint_4", "did you mean -90 deg?"),
        ("percent: 80 %", "percent: 80", 8, "motion.fly.percent", "did you mean 80 %?"),
        ("0 deg, 180 deg, 0 deg", "0 deg, 180 deg", 12, "motion.via_points.box.orientation", "3 values"),
        ("500 mm, 600 mm", "500 mm, -600 mm", 12, "motion.via_points.box.size.1", "greater than or equal to 0"),
        ("mass: 2.1 kg", "mass: -2.1 kg", 2, "tool.mass", "greater than or equal to 0"),
        ("mass: 2.1 kg", "mass: 2.1 N", 2, "tool.mass", "kg, g"),
        ("max: [1.6 m", "max: [0.3 m", 4, "cell.keep_out.0.box", "on x it is 0.4 m to 0.3 m"),
        ("joint_4: [", "joint_7: [", 5, "cell.joint_ranges.joint_7", "allowed are joint_1"),
        ("[-90 deg, 2]", "[-90 deg]", 5, "cell.joint_ranges.joint_4", "lower, upper"),
        ("[-90 deg, 2]", "[-90 mm, 2]", 5, "cell.joint_ranges.joint_4", "'mm' is a unit of a length"),
        ("[-90 deg, 2]", "[-90 kg, 2]", 5, "cell.joint_ranges.joint_4.0", "'kg' is a unit of a mass"),
        ("[-90 deg, 2]", "[2, -90 deg]", 5, "cell.joint_ranges.joint_4", "must come first"),
        ("[-90 deg, 2]", "[13 rad, 14 rad]", 5, "cell.joint_ranges.joint_4", "outside the joint's own range"),
        ("driver: tcp", "driver: rs232", 3, "controller.driver", "tcp"),
        ("population: 20", "population: 2.5", 13, "search.population", "integer"),
        ("population: 20", "population: true", 13, "search.population", "integer"),
        ("seed: 7", "seed: -7", 13, "search.seed", "greater than or equal to 0"),
        ("method: random", "method: ransom", 13, "search.method", "'genetic' or 'random'"),
        ("interpolator: fly", "interpolator: crawl", 13, "search.interpolator", "allowed are fly"),
        ("cutoff: 20 Hz", "cutoff: 125 Hz", 15, "estimate.filter.cutoff", "half of record.rate"),
        ("method: huber", "method: extraordinary", 15, "estimate.method", "'weighted'"),
        ("every: 12 h", "every: 12 Hz", 18, "recalibrate.every", "min, h, d"),
        ("speed: 0.2 m/s, ", "speed: 0.2 m/s, speed: 0.3 m/s, ", 16, "", "duplicate key"),
        ("robot: comau_ns16", "robot: comau_ns61", 1, "robot", "comau_ns16"),
        ("gate: {normalised_rmse: 0.05}", "gate: 0.05", 17, "gate", "normalised_rmse"),
        ("normalised_rmse: 0.05", "normalised_rmse: 5", 17, "gate.normalised_rmse", "did you mean 5 %?"),
        ("address: 127.0.0.1:9100", "address: 127.0.0.1", 3, "controller.address", "host:port is expected"),
        ("[1.0 m, 0 m", "[1e300 m, 0 m", 12, "motion.via_points.box.centre.0", "less than or equal to 100"),
        ("[500 mm,", "[1e9 mm,", 12, "motion.via_points.box.size.0", "less than or equal to 100"),
        ("180 deg, 0 deg]", "180000 deg, 0 deg]", 12, "motion.via_points.box.orientation.1", "less than or equal to"),
        ("0.3 m]}}]", "0.3 m]}}, {name: table, box: {min: [0, 0, 0], max: [1, 1, 1]}}]", 4, "cell.keep_out", "table"),
    ],
)
def test_a_fault_names_file_line_key_and_what_is_allowed(
    recipe_file: Path, old: str, new: str, line: int, key: str, message: str
) -> None:
    assert old in FULL
    faults = faults_of(recipe_file, FULL.replace(old, new))
    assert len(faults) == 1
    assert faults[0].startswith(f"{recipe_file}:{line}: {key}")
    assert message in faults[0]


@pytest.mark.parametrize("law", ["fly", "learned.yaml"])
def test_refuses_settings_unsupported_by_the_controllers_language(recipe_file: Path, monkeypatch, law: str) -> None:
    monkeypatch.setattr(Pdl2, "fly_keys", frozenset({"distance"}))
    monkeypatch.setattr(Pdl2, "interpolators", ("other",))
    faults = faults_of(recipe_file, FULL.replace("interpolator: fly", f"interpolator: {law}"))
    keys = [f"{recipe_file}:8: motion.fly.{key}: " for key in ("percent", "stress", "trajectory", "type")]
    assert [fault.startswith(key) for fault, key in zip(faults, keys, strict=False)] == [True] * 4
    assert all("driver tcp; allowed are distance" in fault for fault in faults[:4])
    assert faults[4:] == [
        f"{recipe_file}:13: search.interpolator: there is no interpolator {law!r} for driver tcp; allowed are other"
    ]


def test_the_default_interpolator_is_the_controllers_own(recipe_file: Path, monkeypatch) -> None:
    assert load_text(recipe_file, MINIMAL).interpolator == "fly"
    monkeypatch.setattr(Pdl2, "interpolators", ("other", "fly"))
    assert load_text(recipe_file, MINIMAL).interpolator == "other"
    assert load_text(recipe_file, FULL).interpolator == "fly"


#: Key, text before and after the number, its dimension, and the sizes that need no unit [SI].
WRITTEN = [
    ("cone: 30 deg", "cone: {}", Dimension.ANGLE, 0.0, math.pi / 2, lambda r: r.motion.via_points.box.cone),
    ("0.05", "{}", Dimension.RATIO, 0.0, 0.1, lambda r: r.gate.normalised_rmse),
    ("every: 12 h", "every: {}", Dimension.TIME, 3600.0, math.inf, lambda r: r.recalibrate.every),
    ("distance: 30 mm", "distance: {}", Dimension.LENGTH, 0.0, 2.0, lambda r: r.motion.settings.fly_distance),
    ("speed: 500 mm/s", "speed: {}", Dimension.SPEED, 0.0, 10.0, lambda r: r.motion.speed),
    ("mass: 2.1 kg", "mass: {}", Dimension.MASS, 0.0, 500.0, lambda r: r.tool.mass),
    ("rate: 250 Hz", "rate: {}", Dimension.FREQUENCY, 1.0, math.inf, lambda r: r.record.rate),
]


@given(st.sampled_from(WRITTEN), st.floats(1e-3, 1e6), st.booleans())
@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_bare_number_is_si_or_asks_for_its_unit(recipe_file: Path, place: Any, number: float, quoted: bool) -> None:
    old, new, dimension, least, most, value = place
    text = f'"{number!r}"' if quoted else repr(number)
    unit = next(iter(dimension.value.factors))
    with_unit = f"{100 * number!r} %" if dimension is Dimension.RATIO else f"{number!r} {unit}"

    def load(written: str) -> Any:
        try:
            return load_text(recipe_file, FULL.replace(old, new.format(written)))
        except InputError as error:
            return str(error)

    bare, full = load(text), load(with_unit)
    if least <= number <= most:
        assert isinstance(bare, str) == isinstance(full, str)
        assert isinstance(bare, str) or value(bare) == pytest.approx(value(full), rel=1e-12) == pytest.approx(number)
    else:
        assert "hardly meant here" in bare
        assert "hardly meant" not in str(full), "with its unit it is taken, or has other faults"
        if (guess := re.search(r"did you mean (.+)\?", bare)) is not None:
            assert "hardly meant" not in str(load(guess[1]))


def test_reports_all_faults_at_once(recipe_file: Path) -> None:
    text = FULL.replace("comau_ns16", "nobody").replace("speed: 500 mm/s", "speed: fast").replace("seed: 3", "sed: 3")
    text = text.replace("count: 6", "count: 6\n    like: task.pdl\n    around: 3 kg")
    keys = [fault.split(": ")[1] for fault in faults_of(recipe_file, text)]
    wanted = {"robot", "motion.speed", "validate.sed", "motion.via_points", "motion.via_points.around"}
    assert wanted == set(keys)


def test_refuses_files_that_are_not_recipes(tmp_path: Path) -> None:
    for name, content in {"empty": b"", "list": b"[1, 2]", "latin": b"robot: \xe9\xff", "deep": b"[" * 1000}.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=name):
            load_recipe(path)
    for path in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(InputError, match=re.escape(str(path))):
            load_recipe(path)


@pytest.mark.parametrize(
    "text", ["cell: " + "[" * 3000, "cell: " + "{a: " * 3000, "cell:\n  " + "- " * 3000, "a: " * 3000]
)
def test_a_document_nested_without_end_is_refused(recipe_file: Path, text: str) -> None:
    (fault,) = faults_of(recipe_file, MINIMAL + text)
    assert re.search(r"recipe\.yaml:[5-6]: .*(nested more than 50 deep|not allowed here)", fault)


def test_valid_parts_can_be_inspected_next_to_wrong_ones(recipe_file: Path) -> None:
    text = (
        FULL.replace("speed: 500 mm/s", "speed: 1 kg")
        .replace("population", "populaton")
        .replace("max: [1.6", "max: [0")
    )
    recipe_file.write_text(text, encoding="utf-8")
    recipe, faults = examine_recipe(recipe_file)
    assert [fault.split(": ")[1] for fault in faults] == ["cell.keep_out.0.box", "motion.speed", "search.populaton"]
    assert recipe is not None
    assert (recipe.motion.speed, recipe.search.population, recipe.search.generations) == (1.0, 50, 10)
    assert recipe.cell.keep_out == ()
    recipe_file.write_text(FULL.replace("count: 6", "count: 1"), encoding="utf-8")
    assert examine_recipe(recipe_file)[0] is None, "nothing stands in for a sub-region"


TOKENS = [
    *("", " ", "\n", ":", "- ", "{", "}", "[", "]", ",", "'", '"', "#", "&a ", "*a", "!!int ", "<<: ", "? ", "|", "%"),
    *("null", "true", ".nan", "-.inf", "1e-3", "0x1F", "1_0", "2020-99-99", "9" * 5000, "mm", "deg", "m/s", "\t"),
    *("\x00", "é", "\u2028", '"\\ud800"', '"\\UFFFFFFFF"', "robot", "points", "count: 6\n"),
]


@st.composite
def mutated_recipes(draw: st.DrawFn) -> str:
    text = draw(st.sampled_from([FULL, MINIMAL, with_via_points(POINTS), with_via_points(TUBE)]))
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(text)))
        length = draw(st.sampled_from([0, 0, 1, 1, 2, 5, 20, 200]))
        text = text[:start] + draw(st.sampled_from(TOKENS)) + text[start + length :]
    return text


@given(mutated_recipes())
@example(".nan")
@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
def test_a_mutated_recipe_loads_or_is_an_input_error(recipe_file: Path, text: str) -> None:
    with contextlib.suppress(InputError):
        assert math.isfinite(load_text(recipe_file, text).motion.speed)


@pytest.mark.parametrize("key", ["percent", "stress"])
def test_percentages_of_the_fly_statement_are_whole(recipe_file: Path, key: str) -> None:
    """The controller's are INTEGER: better said now than after the search."""
    text = FULL.replace("percent: 80 %, stress: 40 %", f"{key}: 33.3 %")
    assert "33.3" in text
    (fault,) = faults_of(recipe_file, text)
    assert f"motion.fly.{key}" in fault
    assert "not a whole percent" in fault
    fine = load_text(recipe_file, text.replace("33.3 %", "57 %")).motion.settings  # 0.57 is a little less than that
    assert {"percent": fine.fly_percent, "stress": fine.stress_percent}[key] == pytest.approx(57.0)


JOINTS = "[{name: turn, max_velocity: 2, max_acceleration: 5}, {name: slide, max_velocity: 1, max_acceleration: 5}]"
TURN = 'lower="-3" upper="3" '


def _with_arm(folder: Path, urdf: str, cell: str = "") -> Path:
    (folder / "two.urdf").write_text(urdf, encoding="utf-8")
    (folder / "two.yaml").write_text(f"name: two\nurdf: two.urdf\ntip_frame: tip\njoints: {JOINTS}\n", encoding="utf-8")
    path = folder / "recipe.yaml"
    path.write_text(MINIMAL.replace("robot: comau_ns16", "robot: two.yaml") + cell, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (f'<limit {TURN}velocity="2" effort="9"/>', "", "joint 'turn' is revolute, .* no lower and no upper limit"),
        (TURN, "", "joint 'turn' is revolute, .* no lower and no upper limit"),
        ('lower="-3" ', "", "joint 'turn' is revolute, .* no lower limit"),
        ('upper="1" ', "", r"joint 'slide' is prismatic, .* no upper limit.*\(m\) or a range into cell\.joint_ranges$"),
        (TURN, 'lower="-170" upper="170" ', "joint 'turn': a range of -170 to 170 rad.*looks like degrees"),
        (TURN, 'lower="-90" upper="25" ', "joint 'turn': a range of -90 to 25 rad.*looks like degrees"),
    ],
)
def test_refuses_missing_limits_and_limits_in_degrees(tmp_path: Path, old, new, message) -> None:
    assert old in URDF
    path = _with_arm(tmp_path, URDF.replace(old, new))
    recipe, faults = examine_recipe(path)
    assert recipe is None
    assert len(faults) == 1
    assert re.search(rf"recipe\.yaml:1: robot: two\.yaml: {message}", faults[0])
    assert load_robot(tmp_path / "two.yaml").dof == 2  # logs of it can be read all the same


@pytest.mark.parametrize(
    ("old", "new", "cell"),
    [
        (TURN, "", "cell: {joint_ranges: {turn: [-90 deg, 90 deg]}}\n"),
        (TURN, 'lower="-170" upper="170" ', "cell: {joint_ranges: {turn: [-90 deg, 90 deg]}}\n"),
        ("revolute", "continuous", ""),
        (TURN, 'lower="-47.2" upper="47.2" ', ""),  # seven turns and a half to either side, as wrists have
    ],
)
def test_accepts_ranges_from_the_cell_and_unlimited_joints(tmp_path, old, new, cell) -> None:
    assert load_recipe(_with_arm(tmp_path, URDF.replace(old, new), cell)).robot.name == "two"
