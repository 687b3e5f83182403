"""plan.json and state.json of a resumed run: any content gives one message or a plan."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from agent.core.errors import InputError
from agent.excitation import Candidates
from agent.pipeline.planning.plan import loop_problem, replan
from agent.recipe import load_recipe
from agent.runs.folder import RunFolder
from tests.app.conftest import RECIPE
from tests.damage import damaged

STATE = {
    "schema": "run/1",
    "robot": "comau_ns16",
    "recipe": "/recipe.yaml",
    "kind": "calibrate",
    "started": "2026-01-01T00:00:00+00:00",
    "status": "stopped",
    "stopped": {"step": "record", "reason": "interrupted", "at": "2026-01-01T00:01:00+00:00"},
    "steps": {"plan": {"finished": "2026-01-01T00:00:30+00:00"}},
    "inputs_sha256": {"recipe.yaml": "s"},
    "versions": {"python": "3.11"},
}


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    """A recipe, and a plan for it as a run keeps it."""
    folder = tmp_path_factory.mktemp("planned")
    path = folder / "recipe.yaml"
    path.write_text(RECIPE.format(address="127.0.0.1:1", cycles=2, motions=1, speed="0.2 m/s", gate=0.03))
    recipe = load_recipe(path)
    genes = Candidates(loop_problem(recipe, recipe.motion.speed)).problem.genes
    genome = np.full(genes, 0.5).tolist()
    return recipe, folder / "plan.json", {"search": {"genome": genome, "fitness": 1.0}, "validation": [genome]}


@settings(max_examples=12, deadline=None)
@given(st.data())
def test_an_edited_plan_loads_or_gives_one_message(planned, data):
    recipe, path, plan = planned
    path.write_text(json.dumps(data.draw(damaged(plan))), encoding="utf-8")
    try:
        made = replan(recipe, path)
    except InputError as error:
        assert path.name in str(error)  # noqa: PT017  either outcome is right
        return
    assert all(np.isfinite(motion.loop.trajectory.q).all() for motion in (made.excitation, *made.validation))


@pytest.mark.parametrize("schema", ["planned-loop/1", "plan/1"])  # the second until it had a name of its own
def test_refuses_the_output_of_agent_plan_as_the_plan_of_a_run(planned, tmp_path, schema):
    recipe, _, plan = planned
    path = tmp_path / "plan.json"
    document = {"schema": schema, "folder": "p", "fitness": 1.0, "cycle_s": 9.0, "search": plan["search"]}
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(InputError, match="what `agent plan` wrote of a loop, not the plan of a run"):
        replan(recipe, path)


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_an_edited_run_state_resumes_or_gives_one_message(tmp_path_factory, data):
    run = tmp_path_factory.mktemp("run")
    (run / "state.json").write_text(json.dumps(data.draw(damaged(STATE))), encoding="utf-8")
    try:
        opened = RunFolder.open(run, "s")
    except InputError as error:
        assert run.name in str(error)  # noqa: PT017  either outcome is right
        return
    assert opened.state["status"] == "running"
    opened.stopped("record", "again")
    assert json.loads((run / "state.json").read_text(encoding="utf-8"))["status"] == "stopped"
