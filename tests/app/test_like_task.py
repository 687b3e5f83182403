"""A recipe whose sub-region is a job in PDL2 as people write it."""

import numpy as np
import pytest

from agent.core import Console, InputError
from agent.pipeline.planning.plan import search_loop
from agent.pipeline.planning.sub_region import via_regions
from agent.recipe import load_recipe
from agent.runs.approved import problem

JOB = """PROGRAM pick &PA
IMPORT 'gripper'
VAR vi_arm : INTEGER
BEGIN
  vi_arm := 1
  WAIT FOR $DIN[3] = ON
  MOVE ARM[vi_arm] TO {0, 0, -90, 0, 60, 0}
  grip(40)
  MOVE ARM[vi_arm] TO {20, 10, -95, 0, 70, 0}
  MOVE ARM[vi_arm] TO {-20, 10, -95, 0, 70, 0}
END pick
"""
RECIPE = """robot: comau_ns16
controller: {driver: tcp, address: 127.0.0.1:9}
motion:
  speed: 1 m/s
  fly: {type: FLY_CART, trajectory: FLY_TOL, distance: 20 mm}
  via_points: {count: 4, like: job.pdl, around: 60 mm}
search: {method: random, population: 4, generations: 1, seed: 1}
"""


def recipe_for(folder, job):
    (folder / "job.pdl").write_text(job, encoding="utf-8")
    (folder / "recipe.yaml").write_text(RECIPE, encoding="utf-8")
    return load_recipe(folder / "recipe.yaml")


@pytest.mark.verify
def test_finds_a_loop_around_the_job(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, _ = search_loop(recipe_for(tmp_path, JOB), Console())
    assert found.loop.trajectory.duration > 1


def test_reports_ignored_statements_and_refuses_a_job_without_motion(tmp_path, capsys):
    still = "\n".join(line for line in JOB.split("\n") if "MOVE" not in line)
    with pytest.raises(InputError, match=r"job\.pdl: nothing in this program moves the arm"):
        search_loop(recipe_for(tmp_path, still), Console())
    assert "job.pdl: 3 lines without motion are skipped (IMPORT 1, WAIT 1, GRIP 1)" in capsys.readouterr().err


def test_taught_positions_come_from_the_variable_file_next_to_the_job(tmp_path):
    taught = JOB.replace("VAR vi_arm", "VAR left, right : JOINTPOS\n vi_arm").replace("{20, 10, -95, 0, 70, 0}", "left")
    recipe = recipe_for(tmp_path, taught.replace("{-20, 10, -95, 0, 70, 0}", "right"))
    with pytest.raises(InputError, match=r"job\.pdl.*left"):
        via_regions(recipe)
    before = problem(recipe)
    listing = "left JNTP Arm: 1 Ax: 6 Priv\n 1:20 2:10 3:-95 4:0 5:70 6:0\n"
    (tmp_path / "job.lsv").write_text(listing + listing.replace("left", "right").replace("1:20", "1:-20"))
    read = via_regions(recipe)
    assert problem(recipe) != before  # what was approved without it is another job
    middle = np.full(read.genes, 0.5)
    assert np.allclose(read.poses(middle), via_regions(recipe_for(tmp_path, JOB)).poses(middle))
