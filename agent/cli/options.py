"""Arguments and options that several commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

RecipePath = Annotated[Path, typer.Argument(metavar="RECIPE", help="recipe file (YAML)")]
Messages = Annotated[
    bool | None,
    typer.Option("-v/-q", "--verbose/--quiet", help="more messages / warnings and the result only", show_default=False),
]
Yes = Annotated[bool, typer.Option("--yes", help="the cell is clear: move without asking")]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object on stdout")]
RobotOption = Annotated[str, typer.Option("--robot", metavar="R", help="built-in robot, robot.yaml, URDF or MJCF")]
Cutoff = Annotated[float | None, typer.Option("--cutoff", metavar="HZ", help="cut-off of the torque filter")]
Topic = Annotated[
    str | None, typer.Option("--topic", metavar="T", help="of the arm's JointState messages, where a log has several")
]
RunsFolder = Annotated[Path, typer.Option("--logs", metavar="DIR", help="where runs are kept")]
AnyRobot = Annotated[str | None, typer.Option("--robot", metavar="R", help="built-in robot, robot.yaml, URDF or MJCF")]
_DRIVES = "built-in robot, or robot.yaml"
DescribedRobot = Annotated[str, typer.Option("--robot", metavar="R", help=_DRIVES)]
AnyDescribedRobot = Annotated[str | None, typer.Option("--robot", metavar="R", help=_DRIVES)]
Serial = Annotated[str | None, typer.Option("--serial", metavar="S", help="serial of one machine")]
Authorised = Annotated[
    Path | None, typer.Option("--authorisation", metavar="FILE", help="a person's word that allows unattended motion")
]
AllowMixed = Annotated[bool, typer.Option("--allow-mixed", help="logs may be of several machines or tools")]
Force = Annotated[bool, typer.Option("--force", help="go on although a log is implausible")]
Method = Annotated[str | None, typer.Option("--method", help="estimator; chosen on held-out data if absent")]
Structure = Annotated[
    str, typer.Option(help="rigid, or auto: also springs, hoses and the like that these logs clearly show")
]
Without = Annotated[
    list[str] | None, typer.Option("--without", metavar="EFFECT", help="leave an effect out of the catalogue")
]
Seed = Annotated[int, typer.Option("--seed", metavar="S", min=0, help="of everything that is drawn")]
Page = Annotated[Path | None, typer.Option("--report", metavar="OUT.html", help="page to write")]
RunName = Annotated[str | None, typer.Argument(metavar="[RUN]", help="run folder, or its name")]
ModelFile = Annotated[Path, typer.Option("--model", metavar="MODEL", help="model file")]
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="MCAP logs")]
NextRecipe = Annotated[
    Path | None,
    typer.Option("--next", metavar="RECIPE", help="plan the motion in its sub-region that tells what is open"),
]
KnownLoad = Annotated[
    str | None,
    typer.Option("--payload", metavar="LOAD", help="known mass at the flange: 'MASS, X, Y, Z' of its centre"),
]
DrivesOff = Annotated[
    Path | None,
    typer.Option("--drives-off", metavar="LOG", help="the arm at rest on its brakes: tells an offset from friction"),
]
UntilSure = Annotated[bool, typer.Option("--until-sure", help="with --record: further motions until it is settled")]
Budget = Annotated[
    str | None, typer.Option("--budget", metavar="TIME", help="of motion for --until-sure; 10 min if absent")
]
PlanningBudget = Annotated[
    str, typer.Option("--planning-budget", metavar="TIME", help="for planning a further motion, after the verdict")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="of a Dask cluster, tcp://…; else this machine")
]
Workers = Annotated[int | None, typer.Option("--workers", metavar="N", min=1, help="local processes; one a core")]


def engine_for(scheduler: str | None, workers: int | None, console: Any) -> Any:
    """Where work is done that has many parts: a Dask cluster, or processes of this machine."""
    from agent.core import DaskEngine, InProcess, LocalProcesses, available_cores

    if scheduler is not None:
        return DaskEngine(scheduler, say=console.say, warn=console.warn)
    count = workers or available_cores()
    return InProcess() if count == 1 else LocalProcesses(count)


def console_for(messages: bool | None) -> Any:
    """What a person sees while a command works."""
    from agent.core import Console

    return Console(verbosity=0 if messages is None else 1 if messages else -1)


def print_found(as_json: bool, found: Any, text: str | None = None) -> None:
    """What a command found, on stdout: one JSON object, or for people `text`, or what `found` itself says."""
    from agent.core import print_json, print_text

    if as_json:
        print_json(found if isinstance(found, dict) else found.to_dict())
    else:
        print_text(found.text() if text is None else text)


@contextmanager
def diagnosis_shown(as_json: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """Show a diagnosis as often as there is more of it: for people at once, first the verdict, then what was planned.

    As JSON it is one object on stdout: the last one, also where the work ends with an error.
    """
    from agent.core import print_json, print_text
    from agent.pipeline import diagnosis_text, planned_text

    last: dict[str, Any] = {}

    def show(found: dict[str, Any]) -> None:
        if not as_json and not last:
            print_text(diagnosis_text(found))
        elif not as_json and found["next_experiment"] != last["next_experiment"]:
            print_text(planned_text(found))
        last.update(found)

    try:
        yield show
    finally:
        if as_json and last:
            print_json(last)
