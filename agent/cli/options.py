"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

RecipePath = Annotated[Path, typer.Argument(metavar="RECIPE", help="recipe file (YAML)")]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="more messages")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="warnings and the result only")]
Yes = Annotated[bool, typer.Option("--yes", help="the cell is clear: move without asking")]
AsJson = Annotated[bool, typer.Option("--json", help="one JSON object on stdout")]
RobotOption = Annotated[str, typer.Option("--robot", metavar="R", help="built-in robot or robot.yaml")]
Cutoff = Annotated[float | None, typer.Option("--cutoff", metavar="HZ", help="cut-off of the torque filter")]
RunsFolder = Annotated[Path, typer.Option("--logs", metavar="DIR", help="where runs are kept")]
Serial = Annotated[str | None, typer.Option("--serial", metavar="S", help="serial of one machine")]
Authorised = Annotated[
    Path | None, typer.Option("--authorisation", metavar="FILE", help="a person's word that allows unattended motion")
]
AllowMixed = Annotated[bool, typer.Option("--allow-mixed", help="logs may be of several machines or tools")]
Force = Annotated[bool, typer.Option("--force", help="go on although a log is implausible")]
Logs = Annotated[list[Path], typer.Argument(metavar="LOG...", help="MCAP logs")]


def console_for(verbose: bool, quiet: bool) -> Any:
    """What a person sees while a command works."""
    from agent.core import Console

    return Console(verbosity=1 if verbose else -1 if quiet else 0)


NextRecipe = Annotated[
    Path | None,
    typer.Option("--next", metavar="RECIPE", help="plan the motion in its sub-region that tells what is open"),
]
UntilSure = Annotated[bool, typer.Option("--until-sure", help="with --record: further motions until it is settled")]
Budget = Annotated[str, typer.Option("--budget", metavar="TIME", help="of motion for --until-sure, as '10 min'")]
