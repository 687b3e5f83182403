"""The output of `agent plan`: program, page and data of a loop, in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agent.core import Console, InputError, TaskEngine, write_atomically
from agent.link import check_cell
from agent.pages import ShownLoop, plan_report
from agent.pipeline.planning.loop_program import LoopMotion
from agent.pipeline.planning.plan import search_loop
from agent.recipe import Recipe
from agent.runs import make_folder, write_json


@dataclass(frozen=True, eq=False)
class PlanFiles:
    """Output of `agent plan`: its folder, the name of the program, the loop, and how it was found."""

    folder: Path
    program: str
    loop: ShownLoop
    search: dict[str, Any]

    @property
    def limit_use(self) -> dict[str, float]:
        """Largest share of each kind of joint limit that the loop uses."""
        return {kind: float(values.max()) for kind, values in self.loop.limit_use.items()}

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "schema": "planned-loop/1",
            "folder": str(self.folder),
            "fitness": self.search["fitness"],
            "cycle_s": self.loop.cycle.duration,
            "description": self.loop.description,
            "largest_use_of_limits": self.limit_use,
            "files": [self.program, "plan.json", "plan.html"],
        }

    def text(self) -> str:
        """A few lines for people."""
        use = ", ".join(f"{kind} {100 * value:.0f} %" for kind, value in self.limit_use.items())
        lines = [
            f"fitness {self.search['fitness']:.2f} (higher is better)",
            self.loop.description,
            f"largest use of the joint limits: {use}",
        ]
        return "\n".join([*lines, *(str(self.folder / name) for name in (self.program, "plan.html"))])


def plan_recipe(recipe: Recipe, folder: Path, console: Console, engine: TaskEngine | None = None) -> PlanFiles:
    """Search, check the cell, and write program, page and data into a new folder. Opens no port.

    The `engine` scores candidates; default: one process per core.

    Args:
        recipe: whose loop is searched.
        folder: to write to; it must not hold a plan yet.
        console: where progress is shown.
        engine: scores candidates; None: one process per core.

    Raises:
        InputError: as in `plan_once`, or the folder holds a plan already.
        AgentError: the folder cannot be made.
    """
    if (folder / "plan.json").exists():
        raise InputError(f"{folder}: holds a plan already; name another folder with -o, or move it away")
    made = not folder.exists()
    make_folder(folder, "the plan")  # before the search, which may take long
    try:
        motion, search = search_loop(recipe, console, engine)
        check_cell(recipe, motion.loop.trajectory)
    except BaseException:
        if made:
            folder.rmdir()
        raise
    text, loop = motion.program, shown_loop(recipe, motion)
    files = PlanFiles(folder, f"program{recipe.dialect.suffix}", loop, search)
    for name, content in {files.program: text, **recipe.dialect.messages(text)}.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "plan.html", plan_report(loop, search, text))
    write_json(folder / "plan.json", {**files.to_dict(), "search": search})
    return files


def shown_loop(recipe: Recipe, motion: LoopMotion) -> ShownLoop:
    """A planned loop, for a page."""
    loop = motion.loop
    return ShownLoop(recipe, loop.trajectory, loop.poses[:, :3, 3], motion.cycles)
