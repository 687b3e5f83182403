"""Clocks that were wrong, or are: runs dated in the future, zones, daylight saving, a clock set back in a run."""

import os
import re
import shutil
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from agent.runs import History, PastRun, RunFolder, too_early, watch, wrong_clock
from tests.shop_floor.conftest import edit, runs_of

NOW = datetime(2026, 6, 1, 2, 0, tzinfo=UTC)
DAY = 86_400.0


def _past(started: datetime) -> PastRun:
    stamp = started.astimezone(UTC).isoformat(timespec="seconds")
    return PastRun("r", "arm", "1", "calibrate", stamp, "finished", "c", "l", "p", "", "", None)


def _redate(run: Path, stamp: str) -> None:
    edit(run / "state.json", started=stamp)


@given(st.floats(3600.0, 400 * DAY), st.timedeltas(timedelta(minutes=6), timedelta(days=20_000)))
def test_reports_a_run_dated_in_the_future_and_stays_due(every, ahead):
    past = _past(NOW + ahead)
    assert too_early(past, every, NOW) == ""
    assert "the clock was wrong then, or is now" in wrong_clock(past, NOW)


@given(st.floats(3600.0, 400 * DAY), st.timedeltas(timedelta(minutes=-4), timedelta(days=1000)))
def test_a_run_is_due_after_its_interval_and_not_before(every, age):
    past, part = _past(NOW - age), age.total_seconds() / every
    assert wrong_clock(past, NOW) == ""
    if part >= 1.001:
        assert too_early(past, every, NOW) == ""
    if part < 0.9:
        assert "so the next is due in" in too_early(past, every, NOW)


@given(st.integers(-14 * 60, 14 * 60), st.integers(-14 * 60, 14 * 60), st.floats(0.0, 20 * DAY))
def test_time_zones_do_not_change_the_due_date(then, here, age):
    started = NOW - timedelta(seconds=round(age))
    moved = NOW.astimezone(timezone(timedelta(minutes=here)))
    past = _past(started.astimezone(timezone(timedelta(minutes=then))))
    assert too_early(past, 7 * DAY, moved) == too_early(_past(started), 7 * DAY, NOW)


@pytest.mark.parametrize("days", [1, 7])
def test_a_day_of_23_hours_counts_as_a_day(days):
    """A timer at 02:00 local time comes an hour early once a year."""
    assert too_early(_past(NOW - timedelta(days=days, hours=-1)), days * DAY, NOW) == ""
    assert too_early(_past(NOW - timedelta(days=days, hours=-3)), days * DAY, NOW) != ""


def test_runs_are_sorted_by_time_across_time_zones(write_runs):
    logs = write_runs(3)
    first, second, third = runs_of(logs)
    _redate(first, "2026-03-01T02:00:00+14:00")  # the last day of February
    _redate(second, "2026-03-01T00:30:00")
    _redate(third, "2026-02-28T22:00:00-12:00")
    history = History(logs)
    assert [run.run for run in history.runs()] == [first.name, second.name, third.name]
    assert [run.started for run in history.runs()][2] == "2026-03-01T10:00:00+00:00"


def test_a_run_dated_in_the_future_is_the_reference_only_without_another(write_runs):
    logs = write_runs(3)
    first, _, third = runs_of(logs)
    _redate(third, "2041-01-01T00:00:00+00:00")
    history = History(logs)
    assert history.last_accepted("comau_ns16", "l", "tcp x", NOW).run != third.name
    assert history.last_accepted("comau_ns16", "l", "tcp x", datetime(1970, 1, 2, tzinfo=UTC)).run == third.name
    _redate(first, "yesterday")
    history = History(logs)
    assert [first.name in said for said in history.damaged] == [True]


def test_a_clock_set_back_during_a_run_loses_no_data(write_runs, tmp_path, monkeypatch):
    """Steps that end before they began, and files that grow older: the run goes on, and the history takes it in."""
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("robot: comau_ns16\n", encoding="utf-8")
    hours = iter(range(100, 0, -1))

    class SetBack(datetime):
        @classmethod
        def now(cls, tz=None):
            return NOW + timedelta(hours=next(hours))

    monkeypatch.setattr("agent.runs.folder.datetime", SetBack)
    run = RunFolder.create(tmp_path / "logs", "comau_ns16", recipe)
    first, second = run.finish("plan"), run.finish("record")
    assert second["finished"] < first["finished"] < run.state["started"]
    again = RunFolder.open(run.path, run.state["inputs_sha256"]["recipe.yaml"])
    assert again.finished("record") == second

    logs = write_runs(2)
    last = runs_of(logs)[-1] / "state.json"
    history = History(logs)
    assert history.runs()[-1].accepted
    written = last.stat().st_mtime
    edit(last, status="stopped")
    os.utime(last, (written - DAY, written - DAY))
    history = History(logs)
    assert history.runs()[-1].status == "stopped"


def test_trends_leave_out_runs_with_impossible_dates(write_runs):
    logs = write_runs(12, wear=2)
    history = History(logs)
    (before,) = watch(history.runs()[:-1])
    _redate(runs_of(logs)[-1], "2999-01-01T00:00:00+00:00")
    history = History(logs)
    (after,) = watch(history.runs())
    assert after.to_dict() == before.to_dict()


def test_a_clock_once_ahead_does_not_disable_recalibration(shop, run_agent):
    (run,) = _runs_of(shop)
    recipe = shop / "recipe.yaml"
    text = re.sub(r'address: "[^"]*"', 'address: "127.0.0.1:1"', recipe.read_text(encoding="utf-8"))
    recipe.write_text(text.replace("every: 1 s", "every: 7 d"), encoding="utf-8")
    _redate(run, "2041-01-01T00:00:00+00:00")
    begun = run_agent("recalibrate", "recipe.yaml")
    assert begun.returncode == 4, "it is due, and asks the controller"
    assert "dated 2041-01-01" in begun.stderr
    _redate(shutil.copytree(run, run.with_name("another")), datetime.now(UTC).isoformat(timespec="seconds"))
    again = run_agent("recalibrate", "recipe.yaml")
    assert again.stdout.startswith("skipped: the last accepted run"), "the new one counts"
    assert "dated in the future" in run_agent("history").stderr


def _runs_of(shop: Path) -> list[Path]:
    return sorted(path.parent for path in (shop / "logs").glob("*/state.json"))
