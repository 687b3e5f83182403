"""`agent plan`: the loop, its margins and its program, written before anything moves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.core import Console, InputError, TaskEngine, write_atomically
from agent.link import check_cell
from agent.pipeline.planning import PlannedMotion, program_text, search_loop
from agent.recipe import Recipe
from agent.runs import make_folder, write_json

if TYPE_CHECKING:
    from agent.model import IdentifiedModel
    from agent.motion import Trajectory
    from agent.recording import Log
    from agent.report import MotionData, SearchData
    from agent.validation import Prediction


@dataclass(frozen=True, eq=False)
class PlanFiles:
    """What `agent plan` wrote: the folder, the name of the program's file, and what it says of the loop."""

    folder: Path
    program: str
    motion: PlannedMotion
    search: dict[str, Any]
    description: str
    limit_use: dict[str, float]

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "schema": "planned-loop/1",
            "folder": str(self.folder),
            "fitness": self.search["fitness"],
            "cycle_s": self.motion.loop.trajectory.duration,
            "description": self.description,
            "largest_use_of_limits": self.limit_use,
            "files": [self.program, "plan.json", "plan.html"],
        }

    def text(self) -> str:
        """A few lines for people."""
        use = ", ".join(f"{kind} {100 * value:.0f} %" for kind, value in self.limit_use.items())
        lines = [
            f"fitness {self.search['fitness']:.2f} (higher is better)",
            self.description,
            f"largest use of the joint limits: {use}",
        ]
        return "\n".join([*lines, *(str(self.folder / name) for name in (self.program, "plan.html"))])


def plan_recipe(recipe: Recipe, folder: Path, console: Console, engine: TaskEngine | None = None) -> PlanFiles:
    """Search, check the cell, and write program, page and data into a new folder. Opens no port.

    Candidates are scored by the `engine`; without one by a process a core.

    Raises:
        InputError: as in `plan_once`, or the folder holds a plan already.
        AgentError: the folder cannot be made.
    """
    from agent.report import plan_report

    if (folder / "plan.json").exists():
        raise InputError(f"{folder}: holds a plan already; name another folder with -o, or move it away")
    made = not folder.exists()
    make_folder(folder, "the plan")  # before the search, which may take long
    try:
        motion, found = search_loop(recipe, console, engine)
        check_cell(recipe, motion.loop.trajectory)
    except BaseException:
        if made:
            folder.rmdir()
        raise
    text = program_text(recipe, motion)
    data = planned_motion_data(recipe, motion)
    files = PlanFiles(
        folder,
        f"program{recipe.dialect.suffix}",
        motion,
        found,
        data.description[0],
        {kind: float(values.max()) for kind, values in data.limit_use.items()},
    )
    write_atomically(folder / files.program, text)
    write_atomically(folder / "plan.html", plan_report(data, search_data(found), text))
    write_json(folder / "plan.json", {**files.to_dict(), "search": found})
    return files


def planned_motion_data(recipe: Recipe, motion: PlannedMotion) -> MotionData:
    """What a report shows of a loop that was planned from the recipe."""
    return motion_data(recipe, motion.loop.trajectory, motion.loop.poses[:, :3, 3], motion.cycles)


def motion_data(recipe: Recipe, cycle: Trajectory, via_points: np.ndarray, cycles: int) -> MotionData:
    """What a report shows of one planned cycle of a loop through via-points (K, 3) [m]."""
    from agent.report import MotionData, arm_along

    return MotionData(
        robot=recipe.robot.name,
        joints=recipe.robot.joint_names,
        description=(describe(recipe, cycle, len(via_points), cycles),),
        path=cycle.tcp[:, :3, 3],
        via_points=via_points,
        boxes=_boxes(recipe),
        t=cycle.t[::5],
        speed=cycle.path_speed[::5],
        programmed_speed=recipe.motion.speed,
        arm=arm_along(recipe.robot, cycle.t, cycle.q, None if recipe.tool is None else recipe.tool.frame),
        limit_use={name: values[::5] for name, values in limit_use(recipe, cycle).items()},
    )


def with_residual(motion: MotionData, model: IdentifiedModel, log: Path) -> MotionData:
    """The loop coloured by what a model leaves of the torque measured along one cycle of its log."""
    from agent.recording import read_log
    from agent.validation import predict_log

    recorded = read_log(log, model.robot)
    return left_over(motion, recorded, predict_log(model, recorded.middle_part()))


def left_over(motion: MotionData, log: Log, prediction: Prediction) -> MotionData:
    """The same from a prediction at hand: of the worst joint at each time, over nominal torque where all have one."""
    start, stop = log.middle_cycle()
    nominal = prediction.model.robot.nominal_torque
    shares = bool(np.isfinite(nominal).all())
    worst = np.abs(100 * prediction.error / nominal if shares else prediction.error).max(axis=1)
    inside = (prediction.time >= start) & (prediction.time <= stop)
    time = np.linspace(0.0, float(motion.t[-1]), len(motion.path))
    found = np.interp(time, prediction.time[inside] - start, worst[inside])
    return replace(motion, left=found, left_unit="% of nominal torque" if shares else "N·m")


def search_data(found: dict[str, Any]) -> SearchData:
    """What a report shows of a search, from what it left."""
    from agent.report import SearchData

    best, mean = (np.array(found["history"][key], dtype=float) for key in ("best", "mean"))
    return SearchData(found["fitness"], found["evaluated"], best, mean)


def _boxes(recipe: Recipe) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Opposite corners of what surrounds the loop: where via-points may lie, and where the arm must not be."""
    via = recipe.motion.via_points
    boxes = {f"keep-out: {box.name}": (np.array(box.minimum), np.array(box.maximum)) for box in recipe.cell.keep_out}
    if via.box is not None:
        half = np.array(via.box.size) / 2
        boxes["sub-region"] = (np.array(via.box.centre) - half, np.array(via.box.centre) + half)
    for k, point in enumerate(via.points or ()):
        middle, spread = np.array(point.pose[:3]), np.array(point.range[:3])
        boxes[f"region {k + 1}"] = (middle - spread, middle + spread)
    return boxes


def limit_use(recipe: Recipe, trajectory: Trajectory) -> dict[str, np.ndarray]:
    """{kind: (S, n)} how much of each joint limit a trajectory uses; 1 is all of it."""
    from agent.safety import position_ranges

    robot = recipe.robot
    lower, upper = position_ranges(robot, recipe.cell.joint_ranges)
    bounded = np.isfinite(lower) & np.isfinite(upper)
    centre, half = np.zeros(robot.dof), np.full(robot.dof, np.inf)
    centre[bounded], half[bounded] = (lower + upper)[bounded] / 2, (upper - lower)[bounded] / 2
    return {
        "position": np.abs(trajectory.q - centre) / half,
        "speed": np.abs(trajectory.qd) / robot.max_velocity,
        "acceleration": np.abs(trajectory.qdd) / robot.max_acceleration,
    }


def describe(recipe: Recipe, cycle: Trajectory, via_points: int, cycles: int) -> str:
    """A planned loop in one sentence."""
    settings = recipe.motion.settings
    binding = sorted({limit.limit for limit in cycle.binding})
    slowed = f"; slowed down by {', '.join(binding)}" if binding else ""
    return (
        f"{via_points} via-points, {cycle.duration:.1f} s a cycle, {cycles} cycles at {recipe.motion.speed:g} m/s, "
        f"{settings.blend}{slowed}."
    )
