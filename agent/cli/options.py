"""Arguments and options that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from typer import Argument, Option
from typer.core import TyperCommand, TyperOption

from agent import core, pipeline
from agent.cli import completion

#: Groups of commands in the help, in this order.
CALIBRATE, DIAGNOSE, DATA, TOOLS, FLEET = "Calibrate", "Diagnose", "Data and models", "Tools", "Fleet"


class Diagnose(TyperCommand):
    """Help on one screen: the other options are hidden until `--help-all` asks for them."""

    first = ("robot", "model", "record", "report", "out", "next_recipe", "drives_off", "until_sure", "as_json", "yes")

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Show the first options only."""
        for option in self.params:
            if isinstance(option, TyperOption):
                option.hidden = option.name not in (*self.first, "help_all")
        super().format_help(ctx, formatter)


class Emulator(TyperCommand):
    """Passes its options to another program, which Tab asks for them."""

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Options of the emulator, or values of the last one."""
        from click.shell_completion import CompletionItem

        return [CompletionItem(word) for word in completion.emulator(ctx.args, incomplete)]


def _print_all_help(context: typer.Context, wanted: bool) -> None:
    if wanted:
        command: Any = context.command
        TyperCommand.format_help(command, context, context.make_formatter())
        raise typer.Exit


HelpAll = Annotated[bool, Option("--help-all", help="show all options", callback=_print_all_help, is_eager=True)]
RecipePath = Annotated[Path, Argument(metavar="RECIPE", help="recipe file (YAML)", autocompletion=completion.recipes)]
Messages = Annotated[
    bool | None,
    Option("-v/-q", "--verbose/--quiet", help="more messages / only warnings and the result", show_default=False),
]
Yes = Annotated[bool, Option("--yes", help="the cell is clear: move without asking")]
AsJson = Annotated[bool, Option("--json", help="one JSON object on stdout")]
_ANY = "built-in robot, robot.yaml, URDF or MJCF"
RobotOption = Annotated[str, Option("--robot", metavar="R", help=_ANY, autocompletion=completion.robots)]
Cutoff = Annotated[float | None, Option("--cutoff", metavar="HZ", help="cut-off frequency of the torque filter")]
Topic = Annotated[
    str | None, Option("--topic", metavar="T", help="topic of the arm's joint states, if a log has several")
]
Effort = Annotated[
    str | None,
    Option(
        "--effort",
        metavar="WHAT",
        help="what the logs' effort is: current, torque, torque-without-gravity or load",
        autocompletion=completion.efforts,
    ),
]
RunsFolder = Annotated[Path, Option("--logs", metavar="DIR", help="folder of the runs")]
AnyRobot = Annotated[str | None, Option("--robot", metavar="R", help=_ANY, autocompletion=completion.robots)]
_DRIVES = "built-in robot, or robot.yaml"
DescribedRobot = Annotated[str, Option("--robot", metavar="R", help=_DRIVES, autocompletion=completion.robots)]
AnyDescribedRobot = Annotated[
    str | None, Option("--robot", metavar="R", help=_DRIVES, autocompletion=completion.robots)
]
Serial = Annotated[str | None, Option("--serial", metavar="S", help="serial number of the machine")]
Authorised = Annotated[
    Path | None, Option("--authorisation", metavar="FILE", help="file that permits unattended motion")
]
AllowMixed = Annotated[bool, Option("--allow-mixed", help="accept logs of several machines or tools")]
Force = Annotated[bool, Option("--force", help="continue although a log is implausible")]
Method = Annotated[
    str | None,
    Option("--method", help="estimator; by default the best on held-out data", autocompletion=completion.estimators),
]
Structure = Annotated[
    str,
    Option(
        help="rigid, or auto: add springs, hoses and other effects that the logs show",
        autocompletion=completion.structures,
    ),
]
Without = Annotated[
    list[str] | None,
    Option("--without", metavar="EFFECT", help="ignore this effect", autocompletion=completion.effects),
]
Known = Annotated[
    list[str] | None,
    Option("--known", metavar="kp", help="what is right in the simulator's file: kp, the gains of its servos"),
]
Seed = Annotated[int, Option("--seed", metavar="S", min=0, help="seed of all random draws")]
Page = Annotated[Path | None, Option("--report", metavar="OUT.html", help="HTML page to write")]
RunName = Annotated[str | None, Argument(metavar="RUN", help="run folder, or its name")]
ModelFile = Annotated[Path, Option("--model", metavar="MODEL", help="model file")]
Logs = Annotated[list[Path], Argument(metavar="LOG...", help="MCAP logs")]
NextRecipe = Annotated[
    Path | None,
    Option(
        "--next", metavar="RECIPE", help="plan the motion that settles what is open", autocompletion=completion.recipes
    ),
]
KnownLoad = Annotated[
    str | None, Option("--payload", metavar="LOAD", help="known mass at the flange: 'MASS, X, Y, Z' with its centre")
]
DrivesOff = Annotated[
    Path | None, Option("--drives-off", metavar="LOG", help="stationary arm on its brakes: shows a torque offset")
]
UntilSure = Annotated[bool, Option("--until-sure", help="with --record: more motions until the cause is clear")]
Budget = Annotated[
    str | None, Option("--budget", metavar="TIME", help="longest motion time of --until-sure; default 10 min")
]
PlanningBudget = Annotated[str, Option("--planning-budget", metavar="TIME", help="time for planning the next motion")]
Scheduler = Annotated[
    str | None, Option("--scheduler", metavar="ADDRESS", help="Dask scheduler, tls://…; default: local")
]
Workers = Annotated[int | None, Option("--workers", metavar="N", min=1, help="local processes; one per core")]


def engine_for(scheduler: str | None, workers: int | None, console: Any) -> Any:
    """Create the task engine: a Dask cluster, or processes of this machine."""
    if scheduler is not None:
        return core.DaskEngine(scheduler, say=console.say, warn=console.warn)
    count = workers or core.available_cores()
    return core.InProcess() if count == 1 else core.LocalProcesses(count)


def console_for(messages: bool | None) -> Any:
    """Create the console that shows messages and progress."""
    return core.Console(verbosity=0 if messages is None else 1 if messages else -1)


def print_found(as_json: bool, result: Any, text: str | None = None) -> None:
    """Print a result on stdout: one JSON object, or for people `text`, by default that of `result`."""
    if as_json:
        core.print_json(result if isinstance(result, dict) else result.to_dict())
    else:
        core.print_text(result.text() if text is None else text)


def end_job(as_json: bool, outcome: Any) -> NoReturn:
    """Show what a job came to, and end with its exit code."""
    if as_json:
        core.print_json(outcome.result)
    elif outcome.run is None:
        print(outcome.text)
    else:
        print(outcome.text, file=sys.stderr)
        core.print_path(outcome.run)
    raise typer.Exit(0 if outcome.accepted else 3)


@contextmanager
def diagnosis_shown(as_json: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show a diagnosis in steps: for people first the verdict, then the planned motion.

    As JSON it is one object on stdout: the last one, also where the work ends with an error.
    """
    last: dict[str, Any] = {}

    def show(document: dict[str, Any]) -> None:
        if not as_json and not last:
            core.print_text(pipeline.diagnosis_text(document))
        elif not as_json and document["next_experiment"] != last["next_experiment"]:
            core.print_text(pipeline.planned_text(document))
        last.update(document)

    try:
        yield show
    finally:
        if as_json and last:
            core.print_json(last)
