"""Commands over many robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from agent.cli import options as opt
from agent.core import InputError

if TYPE_CHECKING:
    from agent.core import DaskEngine
    from agent.fleet import Summary

app = typer.Typer(no_args_is_help=True, help="Work on many robots, on local cores or a Dask cluster.")

Source = Annotated[str, Argument(metavar="SOURCE", help="folder or URL (s3://…) of folders with logs")]
Out = Annotated[str, Option("-o", "--out", metavar="RESULT", help="folder or URL of the result")]
Robot = Annotated[
    str | None, Option("--robot", metavar="R", help="one robot for all; default: robot.yaml in or above each run")
]
Memory = Annotated[str | None, Option("--memory", metavar="SIZE", help="memory of a local process, such as 2GiB")]
ModelName = Annotated[
    str | None, Option("--model", metavar="MODEL", help="model file for all, or its name in or above each run")
]
Columns = Annotated[
    list[Path] | None,
    Option("--columns", metavar="TABLE", help="CSV or Parquet with column robot and more: cell, batch"),
]


@app.command(epilog="Example: agent fleet estimate logs -o estimates")
def estimate(
    source: Source,
    out: Out,
    robot: Robot = None,
    cutoff: opt.Cutoff = None,
    method: opt.Method = None,
    structure: opt.Structure = "rigid",
    allow_mixed: opt.AllowMixed = False,
    force: opt.Force = False,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    memory: Memory = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Estimate a model for each run of each robot. Skips runs that are done."""
    asked = {"cutoff": cutoff, "method": method, "structure": structure, "allow_mixed": allow_mixed, "force": force}
    work = _up_to_date(scheduler, workers, memory, messages)
    opt.print_found(as_json, work("estimate", source, out, robot, None, **asked))


@app.command(epilog="Example: agent fleet validate logs -o errors")
def validate(
    source: Source,
    out: Out,
    model: ModelName = "model.json",
    cutoff: opt.Cutoff = None,
    allow_mixed: opt.AllowMixed = False,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    memory: Memory = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Validate a model on each run of each robot."""
    work = _up_to_date(scheduler, workers, memory, messages)
    opt.print_found(as_json, work("validate", source, out, None, model, cutoff=cutoff, allow_mixed=allow_mixed))


@app.command(epilog="Example: agent fleet diagnose logs -o diagnoses")
def diagnose(
    source: Source,
    out: Out,
    robot: Robot = None,
    model: ModelName = None,
    cutoff: opt.Cutoff = None,
    without: opt.Without = None,
    allow_mixed: opt.AllowMixed = False,
    force: opt.Force = False,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    memory: Memory = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Diagnose each run of each robot."""
    asked = {"cutoff": cutoff, "without": tuple(without or ()), "allow_mixed": allow_mixed, "force": force}
    work = _up_to_date(scheduler, workers, memory, messages)
    opt.print_found(as_json, work("diagnose", source, out, robot, model, **asked))


def _up_to_date(
    scheduler: str | None, workers: int | None, memory: str | None, messages: bool | None
) -> Callable[..., Summary]:
    """What brings a result up to date on these workers: of a kind, source, result, robot, model and options."""
    from agent.core import DaskEngine, available_cores
    from agent.fleet import make_question, run_fleet

    console = opt.console_for(messages)

    def engine(tasks: int) -> DaskEngine:
        return DaskEngine(scheduler, min(tasks, workers or available_cores()), memory, console.say, console.warn)

    def work(kind: str, source: str, out: str, robot: str | None, model: str | None, **asked: Any) -> Summary:
        return run_fleet(source, make_question(kind, robot, model, **asked), out, engine, console)

    return work


@app.command(epilog="Example: agent fleet simulate -n 20 --weeks 10 -o logs")
def simulate(
    machines: Annotated[int, Option("-n", "--machines", metavar="N", min=1, help="number of robots")],
    out: Annotated[str, Option("-o", "--out", metavar="FOLDER", help="new folder or URL")],
    weeks: Annotated[int, Option(metavar="W", min=1, help="runs of each robot, one per week")] = 1,
    seed: opt.Seed = 1,
    robot: Annotated[str, Option(metavar="R", help="built-in robot or robot.yaml")] = "comau_ns16",
    rows: Annotated[bool, Option("--rows", help="write no logs, only the result of `fleet estimate`")] = False,
) -> None:
    """Simulate a fleet with known wear, steps and causes (truth.csv). Prints what it wrote."""
    from agent.fleet import simulate_fleet

    for written in simulate_fleet(robot, machines, weeks, seed, out, rows):
        print(written)


@app.command(epilog="Example: agent fleet trends estimates")
def trends(
    source: Annotated[str, Argument(metavar="SOURCE", help="result of a fleet, or folder or URL of folders with logs")],
    out: Annotated[
        str | None, Option("-o", "--out", metavar="RESULT", help="folder or URL for the trends as Parquet")
    ] = None,
    columns: Columns = None,
    robot: Robot = None,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    memory: Memory = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Find drifts and steps in a fleet, and groups of robots that share a cause."""
    from agent.fleet import fleet_trends, is_result, write_trends

    result = source
    if not is_result(source):
        if out is None:
            raise InputError(f"{source}: no result of a fleet; name one, or a folder for the result with -o")
        result = f"{out.rstrip('/')}/_estimates"
        _up_to_date(scheduler, workers, memory, messages)("estimate", source, result, robot, None)
    summary = fleet_trends(result, columns or ())
    if out is not None:
        write_trends(summary, out)
    opt.print_found(as_json, summary)


@app.command(epilog="Example: agent fleet report estimates")
def report(
    result: Annotated[str, Argument(metavar="RESULT", help="result of a fleet")],
    columns: Columns = None,
    out: Annotated[
        str | None, Option("-o", "--out", metavar="OUT.html", help="page to write; RESULT/_report.html if absent")
    ] = None,
) -> None:
    """Write an HTML page of the fleet: which machines need attention, and why. Prints its path."""
    from agent.fleet import write_page

    print(write_page(result, columns or (), out))
