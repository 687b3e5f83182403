import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.core import AgentError, InputError, sha256_text
from agent.recipe import Recipe, load_recipe, template
from agent.runs import StoredLoop, find_loop, keep_loop, run_key, stored_loops


@pytest.fixture
def write_recipe(tmp_path: Path) -> Any:
    def write(**values: Any) -> Recipe:
        path = tmp_path / "recipe.yaml"
        path.write_text(template(**values), encoding="utf-8")
        return load_recipe(path)

    return write


def keep(recipe: Recipe, folder: Path, day: int = 1, program: str = "PROGRAM excite\n") -> StoredLoop:
    rng = np.random.default_rng(day)
    return keep_loop(
        recipe,
        genome=rng.random(36),
        poses=rng.random((6, 4, 4)),
        start=rng.random(6),
        fitness=-12.5,
        program_name="excite",
        program=program,
        folder=folder,
        now=datetime(2024, 5, day, tzinfo=UTC),
    )


def test_a_stored_loop_reads_back_unchanged(write_recipe: Any, tmp_path: Path) -> None:
    kept = keep(write_recipe(), tmp_path / "loops")
    assert stored_loops(tmp_path / "loops") == [kept]
    assert kept.checksum == sha256_text("PROGRAM excite\n")
    assert kept.sub_region["box"]["centre"] == [1.0, 0.0, 0.8]
    assert json.loads(json.dumps(kept.to_dict()))["schema"] == "loop/1"
    for part in ("comau_ns16", "no tool", "6 points in box", "-12.50", "excite", kept.checksum[:12], "2024-05-01"):
        assert part in kept.line()
    assert [path.name[0] for path in (tmp_path / "loops").iterdir()] == ["c"]  # no other files are left


def test_finds_the_newest_loop_of_the_same_problem(write_recipe: Any, tmp_path: Path) -> None:
    recipe = write_recipe()
    assert find_loop(recipe, tmp_path / "loops") is None
    keep(recipe, tmp_path / "loops", day=1)
    newest = keep(recipe, tmp_path / "loops", day=3, program="PROGRAM third\n")
    keep(recipe, tmp_path / "loops", day=2, program="PROGRAM second\n")
    assert find_loop(recipe, tmp_path / "loops") == newest
    assert len(stored_loops(tmp_path / "loops")) == 3
    # neither the controller nor the number of cycles changes which loop is right
    assert find_loop(write_recipe(address="10.0.0.1:1", cycles=7), tmp_path / "loops") == newest
    assert find_loop(write_recipe(cone="29 deg"), tmp_path / "loops") is None


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("speed: 1 m/s", "speed: 0.9 m/s"),
        ("count: 6", "count: 7"),
        ("distance: 20 mm", "distance: 21 mm"),
        ("rate: 500 Hz", "rate: 250 Hz"),
        ("# tool:", "tool: {mass: 1 kg} # "),
        ("# cell:\n", "cell: {keep_out: [{name: a, box: {min: [0, 0, 0], max: [1, 1, 1]}}]}\n"),
        ("# cell:\n", "cell: {joint_ranges: {joint_4: [-200 deg, 200 deg]}}\n"),
    ],
)
def test_what_changes_the_loop_changes_the_key(tmp_path: Path, old: str, new: str) -> None:
    text = template()
    assert old in text
    recipes = []
    for name, content in {"one": text, "other": text.replace(old, new)}.items():
        (tmp_path / name).write_text(content, encoding="utf-8")
        recipes.append(load_recipe(tmp_path / name))
    assert run_key(recipes[0])["loop"] != run_key(recipes[1])["loop"]


def test_the_key_depends_on_the_content_of_a_followed_job(tmp_path: Path) -> None:
    keys = []
    for folder, program in {"a": "PROGRAM one", "b": "PROGRAM one", "c": "PROGRAM two"}.items():
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "task.pdl").write_text(program)
        text = template()
        start, stop = text.index("    box:"), text.index("    # or a region")
        text = text[:start] + "    like: task.pdl\n    around: 50 mm\n" + text[stop:]
        (tmp_path / folder / "recipe.yaml").write_text(text)
        keys.append(run_key(load_recipe(tmp_path / folder / "recipe.yaml"))["loop"])
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("PROGRAM excite", "PROGRAM excise"),
        lambda text: text.replace("loop/1", "loop/9"),
        lambda text: text.replace('"fitness"', '"fitnes"'),
        lambda text: "[]",
    ],
)
def test_a_damaged_file_is_named(write_recipe: Any, tmp_path: Path, damage: Any) -> None:
    keep(write_recipe(), tmp_path / "loops")
    path = next((tmp_path / "loops").iterdir())
    path.write_text(damage(path.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(InputError, match=path.name):
        stored_loops(tmp_path / "loops")
    with pytest.raises(InputError, match=path.name):
        find_loop(write_recipe(), tmp_path / "loops")
    other = keep(write_recipe(), tmp_path / "loops", program="PROGRAM another\n")
    damaged: list[str] = []
    assert stored_loops(tmp_path / "loops", damaged) == [other]
    assert [path.name in said for said in damaged] == [True]
    assert find_loop(write_recipe(), tmp_path / "loops") == other


def test_an_unwritable_folder_gives_one_message(write_recipe: Any, tmp_path: Path) -> None:
    (tmp_path / "loops").write_text("a file in the way")
    with pytest.raises(AgentError, match="loops"):
        keep(write_recipe(), tmp_path / "loops")
