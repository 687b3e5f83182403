"""Commands: parse, call, print, exit code. No mathematics, and nothing heavy imported before it is needed."""

from __future__ import annotations

import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from typer import Argument, Option

from agent import blind_check as blind, core, link, pipeline, recipe as recipes, runs as run_store, simulators
from agent.cli import completion, fleet, options as opt, shop_floor
from agent.core import InputError

app = typer.Typer(
    name="agent",
    add_completion=True,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(version("calibration-agent"))
        raise typer.Exit


@app.callback()
def agent(
    version: Annotated[
        bool, Option("--version", help="print the version and exit", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Measure your robot's real masses and friction, and find out why model and robot disagree."""


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent init cell.yaml --controller 192.0.2.10:9100")
def init(
    recipe: Annotated[Path, Argument(metavar="RECIPE", help="file to write")] = Path("recipe.yaml"),
    robot: opt.AnyDescribedRobot = None,
    driver: Annotated[
        str | None, Option(metavar="NAME", help="driver of the controller", autocompletion=completion.drivers)
    ] = None,
    controller: Annotated[str | None, Option(metavar="ADDRESS", help="address and port")] = None,
    centre: Annotated[str | None, Option(metavar="X,Y,Z", help="centre of the sub-region")] = None,
    size: Annotated[str | None, Option(metavar="X,Y,Z", help="size of the sub-region")] = None,
    orientation: Annotated[str | None, Option(metavar="A,E,R", help="tool angles")] = None,
    cone: Annotated[str | None, Option(metavar="ANGLE", help="how far the tool may tilt")] = None,
) -> None:
    """Write a commented recipe. On a terminal, the command asks for values without an option."""
    values = {"robot": robot, "driver": driver, "controller": controller, "centre": centre, "size": size}
    print(pipeline.write_recipe(recipe, {**values, "orientation": orientation, "cone": cone}))
    print(f"next: agent check {recipe} (moves nothing)", file=sys.stderr)


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent check cell.yaml")
def check(recipe: opt.RecipePath, as_json: opt.AsJson = False, messages: opt.Messages = None) -> None:
    """Check recipe, reach, limits and cell, and ping the controller. Moves nothing."""
    opt.print_found(as_json, findings := pipeline.check_recipe(recipe, opt.console_for(messages)))
    raise typer.Exit(findings.exit_code)


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent plan cell.yaml -o plan")
def plan(
    recipe: opt.RecipePath,
    out: Annotated[Path | None, Option("-o", "--out", metavar="DIR", help="folder for the plan")] = None,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Search for a calibration motion and write its program. Moves nothing and opens no port.

    Of an MJCF with position servos, a minute of set-points: tables, and a LeRobot dataset to replay.
    """
    console = opt.console_for(messages)
    if simulators.is_simulator(recipe):
        opt.print_found(as_json, pipeline.plan_of_file(recipe, out or Path(f"{recipe.stem}_plan"), console))
        return
    loaded = recipes.load_recipe(recipe)
    chosen = scheduler is not None or workers is not None
    with opt.engine_for(scheduler, workers, console) if chosen else nullcontext() as engine:
        result = pipeline.plan_recipe(loaded, out or Path(f"{recipe.stem}_plan"), console, engine)
    opt.print_found(as_json, result)


@app.command(rich_help_panel=opt.CALIBRATE, epilog="Example: agent calibrate cell.yaml")
def calibrate(
    recipe: opt.RecipePath,
    resume: Annotated[str | None, Option(metavar="RUN", help="continue a stopped run (folder or name)")] = None,
    logs: opt.RunsFolder = Path("logs"),
    yes: opt.Yes = False,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Calibrate the robot: plan, record, estimate, validate and report. Prints the run folder."""
    console = opt.console_for(messages)
    stopped = None if resume is None else run_store.find_run(logs, resume)
    outcome = pipeline.run_calibration(recipes.load_recipe(recipe), console, logs=logs, resume=stopped, yes=yes)
    opt.end_job(as_json, outcome)


@app.command(cls=opt.Diagnose, rich_help_panel=opt.DIAGNOSE, epilog="Example: agent diagnose --model arm.xml loop.mcap")
def diagnose(
    logs: Annotated[list[Path] | None, Argument(metavar="LOG...", help="MCAP logs")] = None,
    robot: opt.AnyRobot = None,
    model: Annotated[
        Path | None, Option(metavar="MODEL", help="model to compare with: model file, MJCF or URDF")
    ] = None,
    joint_map: Annotated[
        Path | None, Option("--map", metavar="MAP.yaml", help="names of the simulator's joints in the logs")
    ] = None,
    record: Annotated[
        Path | None,
        Option(metavar="RECIPE", help="record the recipe's motions, then diagnose", autocompletion=completion.recipes),
    ] = None,
    cutoff: opt.Cutoff = None,
    without: opt.Without = None,
    known: opt.Known = None,
    topic: opt.Topic = None,
    effort: opt.Effort = None,
    allow_mixed: opt.AllowMixed = False,
    force: opt.Force = False,
    as_json: opt.AsJson = False,
    report: opt.Page = None,
    out: Annotated[
        Path | None,
        Option("-o", "--out", metavar="OUT", help="corrected model, MJCF or URDF to write; with --next, the folder"),
    ] = None,
    next_recipe: opt.NextRecipe = None,
    load: opt.KnownLoad = None,
    drives_off: opt.DrivesOff = None,
    until_sure: opt.UntilSure = False,
    budget: opt.Budget = None,
    planning_budget: opt.PlanningBudget = "60 s",
    runs: opt.RunsFolder = Path("logs"),
    yes: opt.Yes = False,
    messages: opt.Messages = None,
    help_all: opt.HelpAll = False,
) -> None:
    """Find out why model and robot disagree: which joint, what causes it, how sure, and what to do next."""
    question = pipeline.GapQuestion(
        model=model,
        joint_map=joint_map,
        cutoff=cutoff,
        without=tuple(without or ()),
        report=report,
        out=out,
        allow_mixed=allow_mixed,
        force=force,
        next_recipe=next_recipe,
        next_payload=load,
        drives_off=drives_off,
        topic=topic,
        effort=effort,
        known=tuple(known or ()),
        planning_budget=pipeline.planning_time(planning_budget),
    )
    console = opt.console_for(messages)
    if budget is not None and not until_sure:
        raise InputError("diagnose: --budget limits the motions of --until-sure: give that too, or leave --budget out")
    if until_sure and next_recipe is not None:
        raise InputError("diagnose: --until-sure plans its motions in the recipe of --record: leave out --next")
    if record is not None:
        if logs or robot:
            raise InputError("diagnose: --record records new logs of the recipe's robot: leave out LOG and --robot")
        motion = pipeline.budget_of(pipeline.BUDGET if budget is None else budget) if until_sure else None
        with opt.diagnosis_shown(as_json) as show:
            pipeline.diagnose_recording(record, question, console, runs, yes, motion, show)
    elif until_sure:
        raise InputError("diagnose: --until-sure moves the robot: name the recipe to record with --record RECIPE")
    elif not logs or not (robot or model):
        raise InputError(
            "diagnose: name the robot (--robot R or --model MODEL) and its logs, or a recipe to record (--record)"
        )
    else:
        with opt.diagnosis_shown(as_json) as show:
            pipeline.diagnose_files(robot, logs, question, console, show)


@app.command(rich_help_panel=opt.DATA, epilog="Example: agent record cell.yaml --program loop.pdl -o loop.mcap")
def record(
    recipe: Annotated[
        Path | None, Argument(metavar="RECIPE", help="recipe file (YAML)", autocompletion=completion.recipes)
    ] = None,
    program: Annotated[Path | None, Option(metavar="P", help="program to run")] = None,
    watch: Annotated[
        str | None,
        Option(metavar="ADDRESS", help="only listen to ros2://DOMAIN/NAMESPACE/CONTROLLER, until Ctrl-C; no recipe"),
    ] = None,
    out: Annotated[Path | None, Option("-o", "--out", metavar="LOG", help="log to write")] = None,
    load: opt.KnownLoad = None,
    yes: opt.Yes = False,
    messages: opt.Messages = None,
) -> None:
    """Send a program to the controller, run it and record the motion; with --watch, only listen."""
    console = opt.console_for(messages)
    if watch is not None:
        if recipe or program or load or yes:
            raise InputError("--watch moves nothing: leave out RECIPE, --program, --payload and --yes")
        if out is None:
            raise InputError("--watch needs the log to write: -o LOG.mcap")
        print(link.record_watched(watch, out, console).path)
        return
    if recipe is None or program is None:
        raise InputError(
            "name RECIPE and --program to move the arm, or --watch ADDRESS to record what something else moves"
        )
    recorded = link.record_program_file(recipes.load_recipe(recipe), program, out, console, yes=yes, payload=load)
    print(recorded.path)


@app.command(rich_help_panel=opt.DATA, epilog="Example: agent estimate --robot comau_ns16 -o model.json loop.mcap")
def estimate(
    logs: opt.Logs,
    robot: opt.RobotOption,
    out: Annotated[Path, Option("-o", "--out", metavar="MODEL", help="model file to write")],
    cutoff: opt.Cutoff = None,
    method: opt.Method = None,
    export: Annotated[
        Path | None,
        Option(metavar="DIR", help="also write URDF, MuJoCo model and friction file (physically consistent)"),
    ] = None,
    structure: opt.Structure = "rigid",
    topic: opt.Topic = None,
    effort: opt.Effort = None,
    allow_mixed: opt.AllowMixed = False,
    force: opt.Force = False,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Estimate a model from logs and write the model file."""
    fit = pipeline.FitQuestion(
        cutoff=cutoff,
        method=method,
        structure=structure,
        topic=topic,
        effort=effort,
        allow_mixed=allow_mixed,
        force=force,
    )
    model, text = pipeline.estimate_files(robot, logs, out, fit, opt.console_for(messages), export)
    opt.print_found(as_json, model, text)


@app.command(rich_help_panel=opt.DATA, epilog="Example: agent validate --model model.json other.mcap")
def validate(
    logs: opt.Logs,
    model: opt.ModelFile,
    cutoff: opt.Cutoff = None,
    topic: opt.Topic = None,
    effort: opt.Effort = None,
    allow_mixed: opt.AllowMixed = False,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Compare predicted and measured torque on logs that took no part in the fit."""
    result = pipeline.validate_files(model, logs, cutoff, opt.console_for(messages), allow_mixed, topic, effort)
    opt.print_found(as_json, result.to_dict(), pipeline.validation_text(result))


@app.command(rich_help_panel=opt.TOOLS, epilog="Example: agent blind-check --cases 20 --seed 1 -o blind")
def blind_check(
    answers: Annotated[
        list[Path] | None, Argument(metavar="ANSWERS.jsonl", help="with --score: answers of a tool")
    ] = None,
    cases: Annotated[int, Option(metavar="N", help="number of simulated runs")] = 400,
    seed: Annotated[
        int | None, Option(metavar="S", min=0, help="draw development cases; without it, the cases for scoring")
    ] = None,
    world: Annotated[str, Option(metavar="WORLD", help="emulator or mujoco")] = "emulator",
    out: Annotated[
        Path | None, Option("-o", "--out", metavar="DIR", help="folder of the results; default blind_check")
    ] = None,
    export: Annotated[
        Path | None, Option(metavar="DIR", help="only write the runs, for another tool; needs --key")
    ] = None,
    key: Annotated[Path | None, Option(metavar="KEY.json", help="answer key, outside DIR")] = None,
    score: Annotated[Path | None, Option(metavar="KEY.json", help="only score answers against this key")] = None,
    scheduler: opt.Scheduler = None,
    workers: opt.Workers = None,
    as_json: opt.AsJson = False,
    messages: opt.Messages = None,
) -> None:
    """Score the diagnosis, or another tool, on simulated robots with a hidden effect."""
    console = opt.console_for(messages)
    if score is not None:
        if export is not None or key is not None or not answers:
            raise InputError("blind check: --score KEY.json takes files of answers, and neither --export nor --key")
        scores = blind.score_answers(score, answers, out)
        opt.print_found(as_json, scores, blind.summary_of(scores))
        return
    if answers or (export is None) != (key is None):
        raise InputError("blind check: --export DIR and --key KEY.json go together; answers need --score KEY.json")
    with opt.engine_for(scheduler, workers, console) as engine:
        if export is not None and key is not None:
            made = blind.export_runs(
                blind.world_of(world), export.absolute(), key.absolute(), cases, seed, console, engine
            )
            opt.print_found(as_json, {"schema": "blind-export/1", "runs": len(made.runs)}, str(export))
            return
        check = blind.BlindCheck(blind.world_of(world), cases, (out or Path("blind_check")).absolute(), seed)
        scores = check.run(console, engine)
    opt.print_found(as_json, scores, blind.summary_of(scores))


@app.command(rich_help_panel=opt.TOOLS, epilog="Example: agent trajectories --json")
def trajectories(as_json: opt.AsJson = False) -> None:
    """List the stored calibration motions by robot, tool, sub-region and checksum."""
    damaged: list[str] = []
    loops = run_store.stored_loops(damaged=damaged)
    for warning in damaged:
        print(f"warning: {warning}", file=sys.stderr)
    if as_json:
        core.print_json({"schema": "trajectories/1", "trajectories": [loop.to_dict() for loop in loops]})
        return
    if loops:
        core.print_text("\n".join(loop.line() for loop in loops))
    elif not damaged:
        print("no stored loops yet: `agent plan` and `agent calibrate` keep what they find", file=sys.stderr)


@app.command("import", rich_help_panel=opt.DATA, epilog="Example: agent import --robot ur5e --map m.yaml a.csv b.mcap")
def import_(
    files: Annotated[
        list[Path], Argument(metavar="IN... OUT", help="tables, then the log to write; or a dataset and a folder")
    ],
    robot: opt.RobotOption,
    mapping: Annotated[Path | None, Option("--map", metavar="MAP.yaml", help="meaning of each column")] = None,
    preset: Annotated[
        str | None,
        Option(metavar="NAME", help="a known recorder: ur-rtde, ur-record, lerobot, pace, isaac-sysid or isaaclab"),
    ] = None,
    topic: opt.Topic = None,
    effort: opt.Effort = None,
    messages: opt.Messages = None,
) -> None:
    """Convert tables to a log, or a dataset to a log for each episode."""
    if len(files) < 2:
        raise InputError("import: name at least one table and the log to write: agent import … IN OUT.mcap")
    if mapping is not None and preset is not None:
        raise InputError(pipeline.MAP_OR_PRESET)
    for note in pipeline.import_files(robot, mapping or preset, files[:-1], files[-1], topic, effort):
        opt.console_for(messages).say(note)
    print(files[-1])


@app.command(
    cls=opt.Emulator,
    rich_help_panel=opt.TOOLS,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
)
def emulator(context: typer.Context) -> None:
    """Start an emulated controller. `agent emulator --help` lists its options."""
    os.execv(sys.executable, [sys.executable, "-m", "fake_controller", *context.args])


app.registered_commands += shop_floor.app.registered_commands
app.add_typer(fleet.app, name="fleet", rich_help_panel=opt.FLEET)
