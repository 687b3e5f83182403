"""Commands for operation: recalibration, schedule, past runs, current model, pages."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from agent import core, model as models, pipeline, recipe as recipes, runs as run_store, safety, simulators
from agent.cli import completion, options as opt
from agent.core import InputError

app = typer.Typer()


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent recalibrate cell.yaml")
def recalibrate(
    recipe: opt.RecipePath,
    logs: opt.RunsFolder = Path("logs"),
    authorisation: opt.Authorised = None,
    yes: opt.Yes = False,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Repeat the stored motion, re-estimate the friction and keep an accepted result. For cron and timers."""
    allowed = None if authorisation is None else safety.load_authorisation(authorisation)
    outcome = pipeline.run_recalibration(recipes.load_recipe(recipe), opt.console_for(messages), logs, yes, allowed)
    opt.end_job(as_json, outcome)


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent schedule cell.yaml --at 02:30 --install")
def schedule(
    recipe: opt.RecipePath,
    logs: opt.RunsFolder = Path("logs"),
    at: Annotated[str, Option(metavar="HH:MM", help="time of day")] = "02:00",
    authorisation: opt.Authorised = None,
    install: Annotated[bool, Option("--install", help="write the systemd units of this user")] = False,
) -> None:
    """Print or install a timer (systemd or cron) that recalibrates."""
    if authorisation is None:
        print("without --authorisation FILE, nothing but an emulator on this computer will move", file=sys.stderr)
    else:
        safety.load_authorisation(authorisation)
    made = pipeline.make_schedule(recipes.load_recipe(recipe), logs, Path.cwd(), at, authorisation)
    if not install:
        print(made.text(), end="")
        return
    core.print_text("\n".join(map(str, pipeline.install(made))))
    print(pipeline.next_steps(made), file=sys.stderr)


@app.command(rich_help_panel=opt.DIAGNOSE, epilog="Example: agent history --robot comau_ns16")
def history(
    logs: opt.RunsFolder = Path("logs"),
    robot: Annotated[str | None, Option(metavar="R", help="only runs of this robot")] = None,
    serial: opt.Serial = None,
    as_json: opt.AsJson = False,
) -> None:
    """List past runs: result, errors and drift."""
    past = run_store.History(logs)
    runs = past.runs(robot, serial)
    current, lost = run_store.current_runs(logs)
    data = run_store.history_json(past, runs, current) if as_json else {}
    future = [f"{run.run}: dated in the future; the trends leave it out" for run in runs if run.in_future()]
    for warning in (*past.damaged, *lost, *future):
        print(f"warning: {warning}", file=sys.stderr)
    if as_json:
        core.print_json({**data, "watch": [watch.to_dict() for watch in run_store.watch(runs)]})
        return
    core.print_text(run_store.history_table(runs, current))
    if not runs and not past.damaged:
        print(past.why_none(robot, serial), file=sys.stderr)


@app.command(rich_help_panel=opt.DIAGNOSE, epilog="Example: agent compare logs/*_comau_ns16 --report page.html")
def compare(
    runs: Annotated[list[str], Argument(metavar="RUN RUN", help="run folders, or their names")],
    logs: opt.RunsFolder = Path("logs"),
    report: opt.Page = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Show which parameters changed between runs by more than their uncertainty."""
    if len(runs) < 2:
        raise InputError("compare: name two runs or more: agent compare RUN RUN")
    comparisons = pipeline.compare_runs(
        [run_store.find_run(logs, run) for run in runs], opt.console_for(messages), report
    )
    pairs = [comparison.to_dict() for comparison in comparisons]
    document = pairs[0] if len(pairs) == 1 else {"schema": "comparisons/1", "comparisons": pairs}
    opt.print_found(as_json, document, "\n\n".join(comparison.text() for comparison in comparisons))


@app.command(rich_help_panel=opt.DIAGNOSE, epilog="Example: agent report --index --open")
def report(
    run: opt.RunName = None,
    index: Annotated[bool, Option("--index", help="the page of all runs, with trends")] = False,
    logs: opt.RunsFolder = Path("logs"),
    robot: Annotated[str | None, Option(metavar="R", help="with --index: only this robot")] = None,
    serial: opt.Serial = None,
    show: Annotated[bool, Option("--open", help="open the page in the browser")] = False,
    messages: opt.Messages = None,
) -> None:
    """Write the HTML page of a run, or of all runs. Prints its path."""
    if (run is None) == (not index):
        raise InputError("report: name a run, or give --index for the page of all runs")
    if run is None:
        page = pipeline.write_index(logs, robot, serial)
    else:
        page = pipeline.rebuild_report(run_store.find_run(logs, run), opt.console_for(messages))
    core.print_path(page)
    if show:
        import webbrowser

        webbrowser.open(page.resolve().as_uri())


@app.command(rich_help_panel=opt.DATA, epilog="Example: agent export model.json -o exported")
def export(
    model: Annotated[Path, Argument(metavar="MODEL", help="model file; with --for also an MJCF or URDF")],
    out: Annotated[Path | None, Option("-o", "--out", metavar="DIR", help="folder to write to")] = None,
    simulator: Annotated[
        str | None,
        Option(
            "--for",
            metavar="SIMULATOR",
            help="mjcf, isaaclab, mjlab, usd, newton or genesis; csv for the table of parameters alone",
            autocompletion=completion.simulators,
        ),
    ] = None,
    load: Annotated[
        str | None,
        Option(
            metavar="VENDOR",
            help="print the identified load for ur, abb, kuka, franka or comau",
            autocompletion=completion.vendors,
        ),
    ] = None,
    flange: Annotated[
        str | None, Option(metavar="FRAME", help="with --load: the frame that is the controller's flange")
    ] = None,
) -> None:
    """Write a model as URDF, MuJoCo model, SDF, CSV and Foxglove layout, for a simulator, or print its load."""
    if simulator is not None and out is None and load is None:
        raise InputError(f"export --for {simulator}: name the folder to write to with -o DIR")
    if (out is None) == (load is None) or (load is not None and simulator is not None):
        raise InputError(
            f"export: say what to make of {model}: -o DIR for URDF, MuJoCo model, SDF, friction file and table; "
            f"--for {'|'.join(simulators.TARGETS)}|csv -o DIR for one simulator or the table alone; "
            f"or --load {'|'.join(simulators.VENDORS)} for the load"
            + ("" if out is None or load is None else "; one of them at a time")
        )
    if flange is not None and load is None:
        raise InputError("export: --flange belongs to --load")
    if simulators.is_simulator(model) and simulator in (None, "csv"):
        raise InputError(f"{model}: is a simulator's file: name with --for the simulator that gets its numbers")
    if load is not None:
        loaded = models.IdentifiedModel.load(model)
        text, about = simulators.load_text(simulators.identified_load(loaded, flange), load)
        print(about, end="\n" if about else "", file=sys.stderr)
        core.print_text(text)
    if out is not None:
        core.print_text("\n".join(map(str, _exported(model, out, simulator))))


def _exported(model: Path, out: Path, simulator: str | None) -> tuple[Path, ...]:
    """Write the files that are asked for; what they lack goes to stderr."""

    def say(text: str) -> None:
        print(f"warning: {text}", file=sys.stderr)

    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file; name a folder to write to")
    if simulator not in (None, "csv"):
        return simulators.write_target(simulators.numbers_of_file(model), str(simulator), out, say)
    loaded = models.IdentifiedModel.load(model)
    if simulator == "csv":
        return simulators.export_table(loaded, out)
    loaded, note = models.possible_model(loaded)
    if note:
        say(note)
    return simulators.export_model(loaded, out, say)


@app.command(rich_help_panel=opt.TOOLS, epilog="Example: agent learn-interpolator --robot arm.yaml -o law.yaml a.mcap")
def learn_interpolator(
    logs: opt.Logs,
    robot: opt.DescribedRobot,
    out: Annotated[Path, Option("-o", "--out", metavar="FILE", help="YAML file to write")],
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Learn the controller's interpolation from recorded set-points, for `search.interpolator` of a recipe."""
    opt.print_found(as_json, pipeline.learn_files(robot, logs, out, opt.console_for(messages)))


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent apply 20260101T020000Z_comau_ns16")
def apply(
    run: opt.RunName = None,
    previous: Annotated[bool, Option("--previous", help="go back to the model before")] = False,
    logs: opt.RunsFolder = Path("logs"),
    robot: Annotated[str | None, Option(metavar="R", help="with --previous: only this robot")] = None,
    serial: opt.Serial = None,
    as_json: opt.AsJson = False,
) -> None:
    """Make a run's model the robot's current model. Changes nothing on the controller."""
    if (run is None) == (not previous):
        raise InputError("apply: name the run whose model becomes current, or give --previous")
    applied = (
        run_store.apply_previous(logs, robot, serial)
        if run is None
        else run_store.apply_run(logs, run_store.find_run(logs, run))
    )
    if not as_json:
        print(f"{applied.robot} {applied.serial}: the current model is now that of run {applied.run}", file=sys.stderr)
    opt.print_found(as_json, applied, str(applied.model))


@app.command(rich_help_panel=opt.TOOLS, epilog="Example: agent doctor")
def doctor(logs: opt.RunsFolder = Path("logs"), as_json: opt.AsJson = False) -> None:
    """Check versions, extras, compiled functions, drivers, clock, disk and limits. Says how to fix a fault."""
    opt.print_found(as_json, findings := pipeline.examine_installation(logs))
    raise typer.Exit(findings.exit_code)
