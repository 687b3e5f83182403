"""Whatever a log holds: import, estimate, validate and diagnose give an answer or one clear refusal."""

import csv
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings, strategies as st

from agent.core import AgentError, Console
from agent.model import IdentifiedModel
from agent.pipeline.gap.diagnose import GapQuestion, diagnose_files
from agent.pipeline.identify import FitQuestion, estimate_files, import_files, validate_files
from agent.recording import read_log
from agent.recording.mcap.log_file import STATES, LogFile
from agent.robot import Dynamics, load_robot

RATE, SAMPLES = 125.0, 1000
VALUES = st.sampled_from([0.0, -0.0, 5e-324, -1e-200, 1e-9, 3.0, -40.0, 1e4, 1e9, -1.4e200, np.inf, -np.inf, np.nan])
ROWS = st.integers(0, SAMPLES - 1)
LENGTH = st.sampled_from([1, 2, 4, 30, 300])
CHANNEL = st.sampled_from(["position", "velocity", "effort"])
DAMAGE = st.one_of(
    st.tuples(st.just("value"), ROWS, LENGTH, CHANNEL, st.integers(0, 1), VALUES),
    st.tuples(st.just("stamp"), ROWS, LENGTH, st.sampled_from([-3000.0, -5.0, -0.011, -0.004, 0.003, 0.02, 1.0, 1e6])),
    st.tuples(st.just("late"), st.sampled_from([1e-4, 2e-3, 8e-3, 0.1])),
    st.tuples(st.just("gap"), ROWS, LENGTH),
    st.tuples(st.just("again"), ROWS, LENGTH),
    st.tuples(st.just("swap"), ROWS),
    st.tuples(st.just("only"), ROWS, LENGTH),
    st.tuples(st.just("scale"), CHANNEL, st.sampled_from([0.0, 1e-300, 1e-6, -1.0, 57.3, 1e3, 1e12])),
)


class Columns:
    """Columns of a log that is still whole, to be damaged."""

    def __init__(self, arm: str):
        self.robot = load_robot(arm)
        self.time = 100 + np.arange(SAMPLES) / RATE
        phase = self.time[:, None] * [1.7, 2.9] + [0.3, 1.1]
        rate = np.array([1.7, 2.9])
        self.position, self.velocity = 0.8 * np.sin(phase), 0.8 * rate * np.cos(phase)
        load = Dynamics(self.robot).inverse_dynamics(self.position, self.velocity, -(rate**2) * self.position)
        noise = np.random.default_rng(1).normal(size=load.shape)
        self.effort = load + 3 * np.tanh(self.velocity / 0.01) + self.velocity + 0.05 * noise

    def damage(self, kind: str, *how) -> None:
        """Do one thing to the columns, as a recorder might."""
        size = len(self.time)
        if size == 0:
            return
        rows = (
            slice(how[0] % size, how[0] % size + how[1]) if kind in ("value", "stamp", "gap", "again", "only") else None
        )
        if kind == "value":
            getattr(self, how[2])[rows, how[3]] = how[4]
        elif kind == "stamp":
            self.time[rows] += how[2]
        elif kind == "late":
            self.time = self.time + np.random.default_rng(2).exponential(how[0], size)
        elif kind == "swap":
            self.time[how[0] % size - 1], self.time[how[0] % size] = (
                self.time[how[0] % size],
                self.time[how[0] % size - 1],
            )
        elif kind == "scale":
            with np.errstate(all="ignore"):
                setattr(self, how[0], getattr(self, how[0]) * how[1])
        else:
            index = np.arange(size)
            taken = {
                "gap": np.delete(index, rows),
                "again": np.insert(index, rows.start, index[rows]),
                "only": index[rows],
            }
            for name in ("time", "position", "velocity", "effort"):
                setattr(self, name, getattr(self, name)[taken[kind]])

    def write(self, path: Path) -> Path:
        """A log with these columns."""
        path.unlink(missing_ok=True)
        file = LogFile(path, self.robot.joint_names, self.robot.name, "x", RATE)
        file.write_states(STATES, self.time, self.position, self.velocity, self.effort)
        file.finish()
        file.close()
        return path


def answers(job) -> bool:
    """Whether a job succeeds; all that it may raise is one message to a person."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            job()
    except AgentError as error:
        return not str(error)  # a refusal says why
    return True


def analyse(arm: str, paths: list[Path], folder: Path, diagnose: bool) -> None:
    """Estimate, validate and diagnose."""
    quiet, model = Console(-1), folder / "model.json"
    model.unlink(missing_ok=True)
    if answers(lambda: estimate_files(arm, paths, model, FitQuestion(), quiet)):
        assert np.all(np.isfinite(IdentifiedModel.load(model).values))
    else:
        assert not model.exists()
    if model.exists():
        answers(lambda: validate_files(model, paths, None, quiet))
    if diagnose:
        answers(lambda: diagnose_files(arm, paths, GapQuestion(model if model.exists() else None), quiet))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("damaged")


def check(arm: str, folder: Path, damages: list, diagnose: bool) -> None:
    columns = Columns(arm)
    for kind, *how in damages:
        columns.damage(kind, *how)
    assume(len(columns.time))
    path = columns.write(folder / "log.mcap")

    def read() -> None:
        log = read_log(path, columns.robot)
        assert np.abs(log.position).max() <= 1e4
        assert log.effort is None or np.abs(log.effort).max() <= 1e9
        assert np.all(np.diff(log.t) > 0)

    if answers(read):
        analyse(arm, [path], folder, diagnose)


MAP = """\
time: {column: time}
position: {columns: [q1, q2], unit: rad}
effort: {columns: [e1, e2], unit: N·m}
"""


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(DAMAGE, min_size=1, max_size=3))
def test_any_damaged_table_gives_a_result_or_one_message(arm, folder, damages):
    columns = Columns(arm)
    for kind, *how in damages:
        columns.damage(kind, *how)
    table, mapping, log = folder / "table.csv", folder / "map.yaml", folder / "table.mcap"
    log.unlink(missing_ok=True)
    mapping.write_text(MAP, encoding="utf-8")
    with open(table, "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", "q1", "q2", "e1", "e2"])
        rows.writerows(np.column_stack([columns.time, columns.position, columns.effort]).tolist())
    if answers(lambda: import_files(arm, mapping, [table], log)):
        analyse(arm, [log], folder, diagnose=False)
    else:
        assert not log.exists()


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(DAMAGE, min_size=1, max_size=3))
@example([("scale", "effort", 1e-300)])
@example([("scale", "velocity", 1e-300)])
@example([("value", 0, 300, "position", 0, 0.0), ("scale", "position", 1e-300)])
def test_any_damaged_log_gives_a_result_or_one_message(arm, folder, damages):
    check(arm, folder, damages, diagnose=False)


@pytest.mark.verify
@settings(max_examples=400, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(DAMAGE, min_size=1, max_size=4))
def test_any_of_many_damaged_logs_gives_a_result_or_one_message(arm, folder, damages):
    check(arm, folder, damages, diagnose=True)
