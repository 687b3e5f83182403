"""Commands over many robots."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from agent.cli import options as opt
from agent.core import InputError

if TYPE_CHECKING:
    from agent.core import DaskEngine
    from agent.fleet import Summary

app = typer.Typer(no_args_is_help=True, help="The same over many robots, on local cores or a Dask scheduler.")

Source = Annotated[str, typer.Argument(metavar="SOURCE", help="folder or URL (s3://…) of folders with logs")]
Out = Annotated[str, typer.Option("-o", "--out", metavar="RESULT", help="folder or URL of the result")]
Robot = Annotated[
    str | None,
    typer.Option("--robot", metavar="R", help="of all: built-in robot or robot.yaml; else the one in or above a run"),
]
Memory = Annotated[str | None, typer.Option("--memory", metavar="SIZE", help="limit of a local process, as in 2GiB")]
ModelName = Annotated[
    str | None, typer.Option("--model", metavar="MODEL", help="of all: a file; or its name in or above every run")
]
Columns = Annotated[
    list[Path] | None,
    typer.Option("--columns", metavar="TABLE", help="CSV or Parquet with a column robot: cell, batch, and the like"),
]


@app.command()
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
    """`agent estimate` for every run of every robot: a row and a model each. Only what is new is done."""
    asked = {"cutoff": cutoff, "method": method, "structure": structure, "allow_mixed": allow_mixed, "force": force}
    work = _up_to_date(scheduler, workers, memory, messages)
    opt.print_found(as_json, work("estimate", source, out, robot, None, **asked))


@app.command()
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
    """`agent validate` for every run of every robot."""
    work = _up_to_date(scheduler, workers, memory, messages)
    opt.print_found(as_json, work("validate", source, out, None, model, cutoff=cutoff, allow_mixed=allow_mixed))


@app.command()
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
    """`agent diagnose` for every run of every robot."""
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


@app.command()
def simulate(
    machines: Annotated[int, typer.Option("-n", "--machines", metavar="N", min=1, help="robots of the fleet")],
    out: Annotated[str, typer.Option("-o", "--out", metavar="FOLDER", help="new folder or URL to write to")],
    weeks: Annotated[int, typer.Option("--weeks", metavar="W", min=1, help="runs of each robot, a week apart")] = 1,
    seed: opt.Seed = 1,
    robot: Annotated[
        str, typer.Option("--robot", metavar="R", help="built-in robot or robot.yaml of all of them")
    ] = "comau_ns16",
    rows: Annotated[bool, typer.Option("--rows", help="no logs: the result of `fleet estimate` at once")] = False,
) -> None:
    """A synthetic fleet with known wear, steps and causes (truth.csv), to try things out. Prints what it wrote."""
    from agent.fleet import simulate_fleet

    for written in simulate_fleet(robot, machines, weeks, seed, out, rows):
        print(written)


@app.command()
def trends(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="result of a fleet, or folder or URL of folders with logs")
    ],
    out: Annotated[
        str | None,
        typer.Option("-o", "--out", metavar="RESULT", help="folder or URL for the trends as Parquet, a row an axle"),
    ] = None,
    columns: Columns = None,
    robot: Robot = None,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    memory: Memory = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """What drifts or has stepped in a fleet, at a controlled rate of false discoveries; families that share a cause."""
    from agent.fleet import fleet_trends, is_result, write_trends

    result = source
    if not is_result(source):
        if out is None:
            raise InputError(f"{source}: no result of a fleet; name one, or a folder for the result with -o")
        result = f"{out.rstrip('/')}/_estimates"
        _up_to_date(scheduler, workers, memory, messages)("estimate", source, result, robot, None)
    found = fleet_trends(result, columns or ())
    if out is not None:
        write_trends(found, out)
    opt.print_found(as_json, found)


@app.command()
def report(
    result: Annotated[str, typer.Argument(metavar="RESULT", help="result of a fleet")],
    columns: Columns = None,
    out: Annotated[
        str | None, typer.Option("-o", "--out", metavar="OUT.html", help="page to write; RESULT/_report.html if absent")
    ] = None,
) -> None:
    """One HTML page over a fleet: which machines need a look and why, all by joints, families. Prints its path."""
    from agent.fleet import write_page

    print(write_page(result, columns or (), out))
