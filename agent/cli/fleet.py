"""Commands over many robots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from agent.cli.options import AllowMixed, AsJson, Cutoff, Force, Quiet, Verbose, console_for
from agent.core import InputError

app = typer.Typer(no_args_is_help=True, help="The same over many robots, on local cores or a Dask scheduler.")

Source = Annotated[str, typer.Argument(metavar="SOURCE", help="folder or URL (s3://…) of folders with logs")]
Out = Annotated[str, typer.Option("-o", "--out", metavar="RESULT", help="folder or URL of the result")]
Robot = Annotated[
    str | None,
    typer.Option("--robot", metavar="R", help="of all: built-in robot or robot.yaml; else the one in or above a run"),
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="of a Dask cluster, tcp://…; else this machine")
]
Workers = Annotated[int | None, typer.Option("--workers", metavar="N", min=1, help="local processes; one a core")]
Memory = Annotated[str | None, typer.Option("--memory", metavar="SIZE", help="limit of a local process, as in 2GiB")]
Columns = Annotated[
    list[Path] | None,
    typer.Option("--columns", metavar="TABLE", help="CSV or Parquet with a column robot: cell, batch, and the like"),
]


@app.command()
def estimate(
    source: Source,
    out: Out,
    robot: Robot = None,
    cutoff: Cutoff = None,
    method: Annotated[str | None, typer.Option("--method", help="estimator; chosen on held-out data if absent")] = None,
    structure: Annotated[str, typer.Option(help="rigid, or auto: also effects that the logs clearly show")] = "rigid",
    allow_mixed: AllowMixed = False,
    force: Force = False,
    scheduler: Scheduler = None,
    workers: Workers = None,
    memory: Memory = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """`agent estimate` for every run of every robot: a row and a model each. Only what is new is done."""
    asked = {"cutoff": cutoff, "method": method, "structure": structure, "allow_mixed": allow_mixed, "force": force}
    _run("estimate", source, out, robot, None, asked, (scheduler, workers, memory), as_json, verbose, quiet)


@app.command()
def validate(
    source: Source,
    out: Out,
    model: Annotated[
        str, typer.Option("--model", metavar="MODEL", help="of all: a file; or its name in or above every run")
    ] = "model.json",
    cutoff: Cutoff = None,
    allow_mixed: AllowMixed = False,
    scheduler: Scheduler = None,
    workers: Workers = None,
    memory: Memory = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """`agent validate` for every run of every robot."""
    asked = {"cutoff": cutoff, "allow_mixed": allow_mixed}
    _run("validate", source, out, None, model, asked, (scheduler, workers, memory), as_json, verbose, quiet)


@app.command()
def diagnose(
    source: Source,
    out: Out,
    robot: Robot = None,
    model: Annotated[
        str | None, typer.Option("--model", metavar="MODEL", help="of all: a file; or its name in or above every run")
    ] = None,
    cutoff: Cutoff = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="EFFECT", help="leave an effect out of the catalogue")
    ] = None,
    allow_mixed: AllowMixed = False,
    force: Force = False,
    scheduler: Scheduler = None,
    workers: Workers = None,
    memory: Memory = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """`agent diagnose` for every run of every robot."""
    asked = {"cutoff": cutoff, "without": tuple(without or ()), "allow_mixed": allow_mixed, "force": force}
    _run("diagnose", source, out, robot, model, asked, (scheduler, workers, memory), as_json, verbose, quiet)


def _run(
    kind: str,
    source: str,
    out: str,
    robot: str | None,
    model: str | None,
    asked: dict[str, Any],
    where: tuple[str | None, int | None, str | None],
    as_json: bool,
    verbose: bool,
    quiet: bool,
) -> None:
    from agent.core import print_json

    summary = _do(kind, source, out, robot, model, asked, where, console_for(verbose, quiet))
    if as_json:
        print_json(summary.to_dict())
    else:
        print(summary.text())


def _do(
    kind: str,
    source: str,
    out: str,
    robot: str | None,
    model: str | None,
    asked: dict[str, Any],
    where: tuple[str | None, int | None, str | None],
    console: Any,
) -> Any:
    from agent.core import available_cores, open_engine
    from agent.fleet import make_question, run_fleet

    scheduler, workers, memory = where

    def engine(tasks: int) -> Any:
        return open_engine(scheduler, min(tasks, workers or available_cores()), memory, console.detail)

    return run_fleet(source, make_question(kind, robot, model, **asked), out, engine, console)


@app.command()
def simulate(
    machines: Annotated[int, typer.Option("-n", "--machines", metavar="N", min=1, help="robots of the fleet")],
    out: Annotated[str, typer.Option("-o", "--out", metavar="FOLDER", help="new folder or URL to write to")],
    weeks: Annotated[int, typer.Option("--weeks", metavar="W", min=1, help="runs of each robot, a week apart")] = 1,
    seed: Annotated[int, typer.Option("--seed", metavar="S", help="of everything that is drawn")] = 1,
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
    scheduler: Scheduler = None,
    workers: Workers = None,
    memory: Memory = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """What drifts or has stepped in a fleet, at a controlled rate of false discoveries; families that share a cause."""
    from agent.core import print_json
    from agent.fleet import fleet_trends, is_result, write_trends

    result = source
    if not is_result(source):
        if out is None:
            raise InputError(f"{source}: no result of a fleet; name one, or a folder for the result with -o")
        result = f"{out.rstrip('/')}/_estimates"
        where = (scheduler, workers, memory)
        _do("estimate", source, result, robot, None, {}, where, console_for(verbose, quiet))
    found = fleet_trends(result, columns or ())
    if out is not None:
        write_trends(found, out)
    if as_json:
        print_json(found.to_dict())
    else:
        print(found.text())


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
