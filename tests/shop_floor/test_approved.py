"""What moves is what was approved: files that were changed after a plan, a run or an acceptance are refused by name."""

import contextlib
import copy
import json
import random
import re
import shutil
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import agent.robot
from agent.core import Console, InputError, sha256_file, sha256_text
from agent.pipeline.planning.plan import plan_once, replan
from agent.pipeline.recalibrate import check_loop
from agent.recipe import Recipe, load_recipe, template
from agent.runs import RunFolder, stored_loops
from agent.runs.approved import approve, check_approved, differences, digest, problem
from tests.conftest import drawn
from tests.damage import damaged
from tests.shop_floor.conftest import authorisation

CATALOGUE = Path(agent.robot.__file__).parent / "catalogue" / "comau_ns16"
TOOL = "tool: {frame: [0 mm, 0 mm, 120 mm, 0 deg, 0 deg, 0 deg], mass: 2.1 kg}\n"
CELL = "cell: {keep_out: [{name: table, box: {min: [0.4 m, -1 m, -1 m], max: [1.6 m, 1 m, 0.1 m]}}]}\n"


@pytest.fixture
def planned(tmp_path: Path) -> tuple[Path, RunFolder]:
    """A recipe with a robot of its own, and a run that was started with it."""
    shutil.copytree(CATALOGUE, tmp_path / "arm")
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(template(robot="arm/robot.yaml") + TOOL + CELL, encoding="utf-8")
    loaded = load_recipe(recipe)
    run = RunFolder.create(tmp_path / "logs", loaded.robot.name, recipe)
    approve(run, loaded)
    return recipe, run


@lru_cache
def _loaded(recipe: Path) -> Recipe:
    """For tests that leave the files alone."""
    return load_recipe(recipe)


def resume(recipe: Path, run: RunFolder) -> None:
    loaded = load_recipe(recipe)
    RunFolder.open(run.path, loaded.sha256, check=lambda opened: check_approved(opened, loaded))


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("robot.yaml", "max_velocity: 2.705", "max_velocity: 8.115", "robot.yaml differs .*joint_1 max_velocity was 2"),
        ("robot.yaml", "gear_ratio: 159.261", "gear_ratio: 15.9261", "robot.yaml differs .*joint_2 gear_ratio was 159"),
        ("robot.yaml", "-9.80665", "9.80665", "robot.yaml differs .*gravity.3 was -9.8"),
        ("ns16.urdf", 'upper="', 'upper="1', "the URDF differs .*joint_1 upper was"),
        ("ns16.urdf", "</robot>", "<!-- x --></robot>", "the URDF differs .*another content"),
    ],
)
def test_resume_names_changed_robot_data(planned, file: str, old: str, new: str, said: str):
    recipe, run = planned
    resume(recipe, run)
    path = recipe.parent / "arm" / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    before = (run.path / "state.json").read_bytes()
    with pytest.raises(InputError, match=said):
        resume(recipe, run)
    assert (run.path / "state.json").read_bytes() == before, "a refused resume writes nothing"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mass: 2.1 kg", "mass: 9 kg", "the recipe's tool differs .*mass was 2.1, is 9"),
        ("0.1 m]", "0.3 m]", "the recipe's cell differs .*keep_out.*table.maximum.3 was 0.1, is 0.3"),
        ("cone: 30 deg", "cone: 60 deg", "the recipe's motion.via_points differs .*box.cone"),
        ("speed: 1 m/s", "speed: 1.2 m/s", "the recipe's motion differs .*linear_speed was 1, is 1.2"),
    ],
)
def test_resume_names_the_changed_recipe_part(planned, old: str, new: str, said: str):
    recipe, run = planned
    recipe.write_text(recipe.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match="started with another recipe"):
        resume(recipe, run)
    with pytest.raises(InputError, match=said):
        check_approved(run, load_recipe(recipe))


def test_refuses_a_changed_or_missing_approval_record(planned):
    recipe, run = planned
    path = run.path / "approved.json"
    path.write_text(path.read_text(encoding="utf-8").replace("2.705", "8.115"), encoding="utf-8")
    with pytest.raises(InputError, match="it was changed since the run was planned"):
        resume(recipe, run)
    path.unlink()
    with pytest.raises(InputError, match="nothing says what this run was planned with"):
        resume(recipe, run)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(data=st.data())
def test_any_state_file_is_resumed_or_refused(planned, data):
    recipe, run = planned
    path = run.path / "state.json"
    whole = path.read_bytes()
    try:
        path.write_text(json.dumps(data.draw(damaged(json.loads(whole)))), encoding="utf-8")
        loaded = _loaded(recipe)
        with contextlib.suppress(InputError):
            RunFolder.open(run.path, loaded.sha256, check=lambda opened: check_approved(opened, loaded))
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("text", [b"[" * 200_000, b'{"steps": ' + b"9" * 6000 + b"}", b"\xff\xfe", b"null", b""])
def test_an_invalid_state_file_gives_one_message(planned, text: bytes):
    recipe, run = planned
    (run.path / "state.json").write_bytes(text)
    with pytest.raises(InputError, match=r"state\.json: damaged"):
        resume(recipe, run)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    genome=st.none() | st.integers() | st.text(max_size=3) | st.lists(st.floats() | st.none(), max_size=37),
    validation=st.none() | st.integers() | st.lists(st.none() | st.lists(st.floats(), max_size=3), max_size=2),
)
def test_any_plan_file_is_read_or_refused(planned, genome: Any, validation: Any):
    _, run = planned
    data = {"schema": "plan/1", "search": {"genome": genome, "fitness": None}, "validation": validation}
    path = run.write_text("plan.json", json.dumps(data))
    with pytest.raises(InputError):  # none of these is a whole genome of six points within their regions
        replan(_loaded(planned[0]), path)


@pytest.mark.parametrize("name", ["plan.json", "program.pdl"])
def test_refuses_a_changed_plan(planned, name: str):
    recipe, run = planned
    for key, file in {"plan": "plan.json", "program": "program.pdl"}.items():
        run.write_text(file, "{}")
        run.note(**{key: sha256_file(run.file(file))})
    run.finish("plan")
    run.write_text(name, "{} ")
    with pytest.raises(InputError, match=f"{name}: not the file that this run finished with"):
        plan_once(load_recipe(recipe), run, Console(-1))
    run.file(name).unlink()
    with pytest.raises(InputError, match="it is gone"):
        plan_once(load_recipe(recipe), run, Console(-1))


def _edit_loop(shop: Path, change: Callable[[dict[str, Any]], None]) -> None:
    (path,) = (shop / "logs" / "trajectories").iterdir()
    data = json.loads(path.read_text(encoding="utf-8"))
    change(data)
    data["checksum"] = sha256_text(data["program"])
    path.write_text(json.dumps(data), encoding="utf-8")


#: Millimetres.
DOWN = drawn(350, lambda rng: int(rng.integers(60, 400)))


def _moved(data: dict[str, Any]) -> None:
    """The first via-point lower, program and checksum in keeping."""
    z = f"{1000 * data['poses'][1][2][3]:.3f}"[:-4]
    assert z in data["program"]
    data["program"] = data["program"].replace(z, str(int(z) - DOWN))


def _faster(data: dict[str, Any]) -> None:
    data["program"] = (
        data["program"].replace("$LIN_SPD := 1\n", "$LIN_SPD := 1.4\n").replace("$LIN_SPD = 1,", "$LIN_SPD = 1.4,")
    )


def _other_tool_frame(data: dict[str, Any]) -> None:
    """Set after the program's own frames."""
    loop = "  FOR cycle_number"
    assert loop in data["program"]
    data["program"] = data["program"].replace(loop, f"  $UFRAME := POS(0, 0, -350, 0, 0, 0, '')\n{loop}", 1)


def _out_of_range(data: dict[str, Any]) -> None:
    data["genome"][2] = -0.9


def _another_genome(data: dict[str, Any]) -> None:
    data["genome"][2] = 0.5 * data["genome"][2] + 0.1


@pytest.mark.parametrize("change", [_moved, _faster, _other_tool_frame, _out_of_range, _another_genome])
def test_refuses_a_stored_loop_that_does_not_match_its_search(shop: Path, change: Callable[[dict[str, Any]], None]):
    recipe = load_recipe(shop / "recipe.yaml")
    check_loop(recipe, stored_loops(shop / "logs" / "trajectories")[0])
    _edit_loop(shop, change)
    (loop,) = stored_loops(shop / "logs" / "trajectories")
    with pytest.raises(InputError, match="is not one that this recipe allows"):
        check_loop(recipe, loop)


def test_refuses_a_replaced_loop(shop: Path, run_agent):
    _edit_loop(shop, _moved)
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 2
    assert "has no stored loop" in run.stderr
    assert "with the program that was accepted" in run.stderr
    assert len(list((shop / "logs").glob("*/state.json"))) == 1, "nothing was begun"


def test_refuses_a_replaced_loop_with_a_matching_run_digest(shop: Path, run_agent):
    """The program of the accepted run was put in keeping with the loop: the recipe's sub-region still refuses it."""
    _edit_loop(shop, _moved)
    (loop,) = stored_loops(shop / "logs" / "trajectories")
    (state,) = (shop / "logs").glob("*/state.json")
    text = json.loads(state.read_text(encoding="utf-8"))
    state.write_text(json.dumps({**text, "program": loop.checksum}), encoding="utf-8")
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 2
    assert "is not one that this recipe allows: the target of its move" in run.stderr


def test_refuses_a_loop_of_another_sub_region_under_the_right_key(shop: Path):
    from agent.runs.loop_store import find_loop

    def other_region(data: dict[str, Any]) -> None:
        data["sub_region"]["box"]["centre"][2] -= DOWN / 1000

    recipe = load_recipe(shop / "recipe.yaml")
    assert find_loop(recipe, shop / "logs" / "trajectories") is not None
    _edit_loop(shop, other_region)
    with pytest.raises(InputError, match="its sub_region is not the one that its key stands for"):
        find_loop(recipe, shop / "logs" / "trajectories")


def test_recalibration_names_what_differs_from_the_accepted_run(shop: Path, run_agent):
    recipe = shop / "recipe.yaml"
    recipe.write_text(recipe.read_text(encoding="utf-8").replace("500 mm, 600 mm", "450 mm, 600 mm"), encoding="utf-8")
    run = run_agent("recalibrate", "recipe.yaml")
    assert run.returncode == 2
    assert "motion.via_points differs from the one this run was planned with: box.size.1 was 0.5, is 0.45" in run.stderr


def test_an_authorisation_for_another_cell_prevents_motion(shop: Path, run_agent):
    run = run_agent("recalibrate", "recipe.yaml", "--authorisation", authorisation(shop, problem="0" * 64))
    assert run.returncode == 2
    assert "is for problem 000000000000" in run.stderr


def test_a_finished_run_stores_its_digests(shop: Path):
    (state,) = (shop / "logs").glob("*/state.json")
    told = json.loads(state.read_text(encoding="utf-8"))
    result = json.loads((state.parent / "result.json").read_text(encoding="utf-8"))
    (loop,) = stored_loops(shop / "logs" / "trajectories")
    assert told["approved"] == told["loop"] == loop.key
    for name in ("robot.yaml", "URDF", "tool", "cell", "sub_region", "settings", "interpolator", "program.pdl"):
        assert len(result["provenance"][f"SHA-256 of {name}"]) == 64, name


CUT = drawn(20, lambda rng: int(rng.integers(1, 100_000)))  # bytes


def test_refuses_to_resume_with_a_changed_log(shop: Path, run_agent):
    (state,) = (shop / "logs").glob("*/state.json")
    told = json.loads(state.read_text(encoding="utf-8"))
    for step in ("estimate", "validate", "report", "record"):
        told["steps"].pop(step, None)
    state.write_text(json.dumps({**told, "status": "stopped"}), encoding="utf-8")
    log = state.parent / "excitation.mcap"
    log.write_bytes(log.read_bytes()[:-CUT])
    run = run_agent("calibrate", "recipe.yaml", "--resume", state.parent)
    assert run.returncode == 2
    assert "excitation.mcap: not the file that this run finished with" in run.stderr


def _leaves(value: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where the numbers of plain data are."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _leaves(inner, (*place, key))
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _leaves(inner, (*place, number))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield place


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(which=st.integers(0, 10**6), factor=st.sampled_from([3.0, 1.0 + 1e-12, -1.0, 0.5]))
def test_names_the_part_of_any_changed_number(planned, which: int, factor: float):
    then = problem(_loaded(planned[0]))
    places = list(_leaves(then))
    place = places[which % len(places)]
    now = copy.deepcopy(then)
    holder = now
    for key in place[:-1]:
        holder = holder[key]
    holder[place[-1]] = holder[place[-1]] * factor or 1.0
    said = differences(then, now)
    assert (digest(then) != digest(now)) == bool(said)
    if said:
        assert "differs from the one this run was planned with" in said


@pytest.mark.verify
@pytest.mark.parametrize("seed", range(12))
def test_detects_any_changed_number_of_a_stored_program(shop: Path, seed: int):
    """One digit of a coordinate, a speed or an angle, anywhere; what a controller would not notice may stay."""
    recipe = load_recipe(shop / "recipe.yaml")
    rng = random.Random(seed)

    def one_digit(data: dict[str, Any]) -> None:
        body = data["program"]
        digits = [m.start() for m in re.finditer(r"(?<=[-(, ])\d(?=\d\d)", body)]
        place = rng.choice(digits)
        data["program"] = f"{body[:place]}{(int(body[place]) + rng.randint(1, 8)) % 10}{body[place + 1 :]}"

    _edit_loop(shop, one_digit)
    (loop,) = stored_loops(shop / "logs" / "trajectories")
    with pytest.raises(InputError):
        check_loop(recipe, loop)
