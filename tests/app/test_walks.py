"""The walks of docs/architecture.md, compared with what runs enter: a search, a motion and its log, a diagnosis."""

import inspect
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
import pytest

from agent.core import Console, InProcess
from agent.diagnosis import diagnose
from agent.estimation import estimate
from agent.pipeline.identify import FitQuestion, fit_files
from agent.pipeline.job import EXCITATION, Job
from agent.pipeline.planning.plan import Plan, search_loop
from agent.recipe import load_recipe
from agent.runs import run_key
from fake_controller.plant import Plant
from tests.conftest import ROOT
from tests.small_arms import make_arm, record

Row = tuple[str, str]
QUIET = Console(-1)


class Walk:
    """A walk as the page has it: rows of file and name, its count of turn-backs, packages, and what else is entered."""

    def __init__(self, text: str):
        self.count = int(re.search(r"\((\d+) turn-backs\)", text)[1])
        self.rows: list[Row] = re.findall(r"(?m)^\| `([\w/.]+)` \| `([\w.]+)` \|$", text)
        entered = re.findall(r"(?m)^- `([\w/]+)`: (.*)$", text)
        self.packages = [package for package, _ in entered]
        self.others = [f"{package}/{file}" for package, files in entered for file in re.findall(r"`([\w/.]+)`", files)]

    @property
    def turn_backs(self) -> int:
        """How often the walk comes back to a file that it left."""
        files = [file for k, (file, _) in enumerate(self.rows) if k == 0 or file != self.rows[k - 1][0]]
        return len(files) - len(set(files))


def walks() -> list[Walk]:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    parts = re.split(r"\n(?=A [\w-]+, from )", page.split("## Three walks")[1].split("\n## ")[0])[1:]
    return [Walk(part) for part in parts]


class Trace:
    """Functions of the project that runs enter, by stage; those of `listed` each time, all others once a stage."""

    def __init__(self, listed: set[Row]):
        self.entered: dict[str, list[Row]] = {}
        self._listed = listed
        self._stage = ""
        self._known: dict[tuple[str, CodeType], Row | None] = {}

    def stage(self, name: str) -> None:
        self._stage = name
        self.entered.setdefault(name, [])

    def _enter(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        key = self._stage, frame.f_code
        if key not in self._known:
            self._known[key] = row = self._row(frame.f_code)
            if row is None:
                return
            self.entered[self._stage].append(row)
            if row not in self._listed:
                self._known[key] = None
            if row[1] == "GuardedLink.motion":
                self.stage("sample")
        elif (row := self._known[key]) is not None:
            self.entered[self._stage].append(row)

    @staticmethod
    def _row(code: CodeType) -> Row | None:
        path = Path(code.co_filename)
        if not code.co_flags & inspect.CO_OPTIMIZED or not any(
            path.is_relative_to(ROOT / top) for top in ("agent", "drivers")
        ):
            return None
        return path.relative_to(ROOT).as_posix(), code.co_qualname.split(".<locals>")[0].removesuffix(".__init__")

    @contextmanager
    def on(self) -> Iterator[None]:
        threading.setprofile(self._enter)
        sys.setprofile(self._enter)
        try:
            yield
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


@pytest.fixture(scope="module")
def trace(start_lasting_controller: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Trace:
    """What a small calibration and a diagnosis enter."""
    from tests.app.conftest import RECIPE

    folder = tmp_path_factory.mktemp("walks")
    path = folder / "recipe.yaml"
    address = start_lasting_controller().address
    path.write_text(RECIPE.format(address=address, cycles=2, motions=1, speed="0.2 m/s", gate=0.03), encoding="utf-8")
    recipe, trace = load_recipe(path), Trace({row for walk in walks() for row in walk.rows})
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        trace.stage("via-point")
        with trace.on():
            motion, found = search_loop(recipe, QUIET, InProcess())
            job = Job.start("calibrate", recipe, QUIET, folder / "logs", run_key(recipe), True)
            job.record(Plan(motion, found, ()))
            fit_files(recipe.robot, [job.run.file(EXCITATION)], FitQuestion(), QUIET)
    robot = make_arm("RR")
    healthy, changed = (
        [record(Plant(robot, seed=3), f"m{seed}", seed) for seed in seeds] for seeds in ((11, 12), (21, 22))
    )
    for log in changed:
        assert log.effort is not None
        log.effort[:, 1] += 60 * np.sign(log.velocity[:, 1])
    model = estimate(robot, healthy)
    trace.stage("residual")
    with trace.on():
        diagnose(robot, changed, model)
    return trace


@pytest.mark.parametrize("number", range(3), ids=["via-point", "sample", "residual"])
def test_a_walk_is_what_a_run_enters(trace: Trace, number: int):
    walk, entered = walks()[number], list(trace.entered.values())[number]
    assert walk.turn_backs == walk.count
    at, missed = 0, []
    for row in walk.rows:
        where = next((k for k in range(at, len(entered)) if entered[k] == row), None)
        if where is None:
            missed.append(row)
        else:
            at = where + 1
    assert missed == [], "the run does not enter these after what stands before them"
    files = {file for file, _ in entered if any(file.startswith(f"{package}/") for package in walk.packages)}
    listed = {file for file, _ in walk.rows}
    assert set(walk.others).isdisjoint(listed)
    assert files - listed <= set(walk.others)  # fewer where a cache has the answer
