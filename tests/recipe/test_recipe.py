import hashlib
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from pydantic import BaseModel

from agent.core import Dimension, read_yaml
from agent.motion import FlyTrajectory, FlyType
from agent.recipe import load_recipe, recipe_schema, template
from agent.recipe.schema import ESTIMATION_METHODS, SEARCH_METHODS, RecipeDocument, ToolSection
from tests.recipe.recipes import FULL, MINIMAL, POINTS, TUBE, load_text, with_via_points

ROOT = Path(__file__).parents[2]


def test_every_value_is_converted_to_si(recipe_file: Path) -> None:
    recipe = load_text(recipe_file, FULL)
    assert recipe.path == recipe_file
    assert recipe.sha256 == hashlib.sha256(FULL.encode()).hexdigest()
    assert recipe.robot.name == "comau_ns16"
    assert (recipe.controller.driver, recipe.controller.address) == ("tcp", "127.0.0.1:9100")
    assert (recipe.cell.keep_out[0].name, recipe.cell.keep_out[0].minimum) == ("table", (0.4, -1.0, 0.0))
    assert recipe.cell.joint_ranges == {"joint_4": (pytest.approx(-math.pi / 2), 2.0)}
    assert recipe.motion.speed == 0.5
    motion = recipe.motion.settings
    assert (motion.fly_type, motion.fly_trajectory) == (FlyType.FLY_NORM, FlyTrajectory.FLY_FROM)
    assert (motion.fly_distance, motion.fly_percent, motion.stress_percent) == (0.03, 80.0, 40.0)
    assert recipe.motion.settings_at(0.1).linear_speed == 0.1
    box = recipe.motion.via_points.box
    assert (recipe.motion.via_points.count, box.centre, box.size) == (6, (1.0, 0.0, 0.8), (0.5, 0.6, 0.4))
    assert box.orientation == (0.0, math.pi, 0.0)
    assert box.cone == pytest.approx(math.pi / 6)
    assert (recipe.search.population, recipe.search.generations, recipe.search.seed) == (20, 10, 7)
    assert (recipe.search.method, recipe.search.interpolator) == ("random", "fly")
    assert (recipe.record.rate, recipe.record.cycles) == (250.0, 12)
    assert (recipe.estimate.filter.order, recipe.estimate.filter.cutoff) == (4, 20.0)
    assert recipe.estimate.method == "huber"
    assert (recipe.validate.motions, recipe.validate.speed, recipe.validate.seed) == (5, 0.2, 3)
    assert recipe.gate.normalised_rmse == 0.05
    assert (recipe.recalibrate.every, recipe.recalibrate.parameters) == (43_200.0, "all")


def test_the_tool_mass_acts_at_its_centre_of_mass(recipe_file: Path) -> None:
    tool = load_text(recipe_file, FULL).tool
    flange = tool.frame @ np.append(tool.centre_of_mass, 1.0)
    np.testing.assert_allclose(flange[:3], [0.0, 0.0, 0.06], atol=1e-15)
    np.testing.assert_allclose(tool.frame[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    assert tool.mass == 2.1


def test_omitted_keys_have_their_documented_defaults(recipe_file: Path) -> None:
    recipe = load_text(recipe_file, MINIMAL)
    assert recipe.tool is None
    assert (recipe.cell.keep_out, recipe.cell.joint_ranges) == ((), {})
    assert (recipe.motion.speed, recipe.motion.settings.fly_distance) == (1.0, 0.02)
    assert (recipe.search.population, recipe.search.generations, recipe.search.method) == (50, 40, "genetic")
    assert (recipe.record.rate, recipe.record.cycles, recipe.estimate.method) == (500.0, 100, "auto")
    assert (recipe.validate.motions, recipe.gate.normalised_rmse) == (30, 0.03)


def test_the_alternatives_of_via_points(recipe_file: Path) -> None:
    points = load_text(recipe_file, with_via_points(POINTS)).motion.via_points
    assert points.count == 2
    assert points.points[0].range == pytest.approx((0.01, 0.02, 0.03, 0.0, math.radians(10), 0.0))
    tube = load_text(recipe_file, with_via_points(TUBE)).motion.via_points
    assert (tube.count, tube.tube.radius, tube.tube.path[1][1]) == (4, 0.05, 0.2)
    (recipe_file.parent / "task.pdl").write_text("PROGRAM task\n")
    like = load_text(recipe_file, with_via_points("count: 5, like: task.pdl, around: 50 mm")).motion.via_points
    assert (like.count, like.like, like.around) == (5, str(recipe_file.parent / "task.pdl"), 0.05)


CONTRACT = """\
robot: comau_ns16
tool: {frame: [0 mm, 0 mm, 120 mm, 0 deg, 0 deg, 0 deg], mass: 2.1 kg, centre_of_mass: [0 mm, 0 mm, 60 mm]}
controller: {driver: tcp, address: 127.0.0.1:9100}
cell: {keep_out: [{name: table, box: {min: [0.4 m, -1 m, 0 m], max: [1.6 m, 1 m, 0.3 m]}}]}
motion:
  speed: 1 m/s
  fly: {type: FLY_CART, trajectory: FLY_TOL, distance: 20 mm}
  via_points:
    count: 6
    box:
      {centre: [1.0 m, 0 m, 0.8 m], size: [500 mm, 600 mm, 400 mm], orientation: [0 deg, 180 deg, 0 deg], cone: 30 deg}
search: {population: 50, generations: 40, seed: 1, method: genetic, interpolator: fly}
record: {rate: 500 Hz, cycles: 100}
estimate: {filter: {order: 8, cutoff: 30 Hz}, method: weighted}
validate: {motions: 30, speed: 0.1 m/s, seed: 2}
gate: {normalised_rmse: 0.03}
recalibrate: {every: 7 d, parameters: friction}
"""


def test_the_example_of_the_contract_loads(recipe_file: Path) -> None:
    recipe = load_text(recipe_file, CONTRACT)
    assert (recipe.gate.normalised_rmse, recipe.recalibrate.every) == (0.03, 604_800.0)
    bare = load_text(recipe_file, re.sub(r" (mm/s|m/s|m|kg|Hz)\b(?=[,\]}\s])", "", CONTRACT.replace(" mm", "e-3")))
    assert bare.motion == recipe.motion, "SI without units says the same"
    assert bare.tool.mass == recipe.tool.mass


def test_a_robot_file_is_found_from_the_recipes_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(ROOT / "agent/robot/catalogue/comau_ns16", tmp_path / "cell/arm")
    monkeypatch.chdir(tmp_path)
    recipe = load_text(tmp_path / "cell/recipe.yaml", MINIMAL.replace("comau_ns16", "arm/robot.yaml"))
    assert recipe.robot.dof == 6


@pytest.mark.parametrize("name", ["ns16_quickstart.yaml", "ns16.yaml"])
def test_the_shipped_recipes_load(name: str) -> None:
    recipe = load_recipe(ROOT / "recipes" / name)
    assert (recipe.search.population, recipe.search.generations) == (50, 40)
    assert recipe.record.cycles == (100 if name == "ns16.yaml" else 10)


def test_the_template_round_trips(recipe_file: Path) -> None:
    text = template(address="10.0.0.7:9100", centre="0.9 m, 0.1 m, 0.7 m", cone="20 deg", count=5, cycles=3)
    recipe = load_text(recipe_file, text)
    assert recipe.controller.address == "10.0.0.7:9100"
    assert recipe.motion.via_points.box.centre == (0.9, 0.1, 0.7)
    assert (recipe.motion.via_points.count, recipe.record.cycles) == (5, 3)
    assert recipe.motion.via_points.box.cone == pytest.approx(math.radians(20))


@pytest.mark.parametrize("marker", ["tool:", "cell:"])
def test_the_templates_commented_sections_are_valid(recipe_file: Path, marker: str) -> None:
    lines = template().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith(f"# {marker}"))
    stop = next(k for k in range(start, len(lines)) if not lines[k].startswith("#"))
    lines[start:stop] = [line.removeprefix("# ") for line in lines[start:stop]]
    recipe = load_text(recipe_file, "\n".join(lines))
    assert (recipe.tool is not None) == (marker == "tool:")
    assert len(recipe.cell.keep_out) == (marker == "cell:")


@given(address=st.text(st.characters(codec="utf-8", exclude_categories=("C",)), min_size=1, max_size=30))
@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_address_survives_the_template(recipe_file: Path, address: str) -> None:
    recipe_file.write_text(template(address=address), encoding="utf-8")
    assert read_yaml(recipe_file)["controller"]["address"] == address


def test_the_schema_lists_the_registered_methods() -> None:
    from agent.estimation.identification import methods
    from agent.excitation.genetic import METHODS as SEARCHES

    assert set(ESTIMATION_METHODS) == set(methods())
    assert set(SEARCH_METHODS) == set(SEARCHES)


def test_the_schema_knows_every_key() -> None:
    schema = recipe_schema()
    assert set(schema["properties"]) == {field.alias or name for name, field in RecipeDocument.model_fields.items()}
    assert schema["required"] == ["robot", "controller", "motion"]
    assert schema["additionalProperties"] is False
    assert "20 mm" in schema["$defs"]["FlySection"]["properties"]["distance"]["description"]


def keys_of(model: type[BaseModel], prefix: str = "") -> set[str]:
    keys: set[str] = set()
    for name, field in model.model_fields.items():
        key = f"{prefix}{field.alias or name}"
        section = field.annotation
        nested = isinstance(section, type) and issubclass(section, BaseModel)
        keys |= keys_of(section, f"{key}.") if nested and key != "motion.via_points" else {key}
    return keys


def test_the_documentation_has_every_key_and_unit() -> None:
    text = (ROOT / "docs/recipe.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"^\| `([a-z_.]+)` \|", text, re.MULTILINE))
    tool = {key for key in documented if key.startswith("tool.")}
    assert documented - tool == keys_of(RecipeDocument) - {"tool"}
    assert {key.removeprefix("tool.") for key in tool} == set(ToolSection.model_fields)
    units = {
        unit for dimension in Dimension if dimension is not Dimension.ANGULAR_SPEED for unit in dimension.value.factors
    }
    assert all(f"`{unit}`" in text for unit in units)
