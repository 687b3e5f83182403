"""Learn the controller's interpolation law from recorded logs and their programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agent.core import LARGEST_PROGRAM, Console, InputError, read_text, write_atomically
from agent.link import moving_segments
from agent.motion import (
    Delay,
    FlyInterpolator,
    FlyParameters,
    LearnedLaw,
    Learner,
    MotionError,
    Move,
    Pdl2Settings,
    RecordedMove,
    Statement,
    create_dialect,
    robot_digest,
    way_key,
)
from agent.pipeline.checked_logs import check_one_machine, read_logs
from agent.pipeline.planning.plan import replan
from agent.pipeline.rebuilt_report import recipe_of
from agent.recording import SHORTEST_STOP, Log
from agent.robot import RobotDescription, load_robot
from agent.runs import check_output

#: Range of the ratio of recorded to planned distance between two stops.
_SHORTER, _LONGER = 0.5, 2.0
#: Tolerance [rad, m] of a stop's position, and the smallest motion.
_THERE = 2e-3
#: Number of stretches to learn from, the longest first: more add little.
_MAX_MOVES = 6


@dataclass(frozen=True)
class Learned:
    """A law and the file it was written to."""

    law: LearnedLaw
    path: Path
    stretches: int

    def text(self) -> str:
        """For a terminal."""
        law = self.law
        before, after = law.figures["before"], law.figures["after"]
        p = law.parameters
        ramps = "speeds averaged over a window" if p.ramps == "window" else "one speed a move and a corner"
        rise = (
            "" if p.ramps == "window" else ", trapezoidal" if p.rise < 1e-3 else f", S-curves of {1e3 * p.rise:.0f} ms"
        )
        lines = [
            f"{law.robot}: blends {p.blend}, {ramps}{rise}, {100 * p.acceleration:.1f} % of the acceleration limits",
            f"path error {before['path_mm']:.3f} mm before, {after['path_mm']:.3f} mm after",
            f"time error {before['time_percent']:.3f} % before, {after['time_percent']:.3f} % after",
            *(f"a stop with {word} takes {1e3 * seconds:.0f} ms to settle" for word, seconds in law.settling_s.items()),
            f"learned from {self.stretches} stretches between stops, and judged on the same; in a recipe: "
            f"search: {{interpolator: {self.path.name}}}",
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "schema": "learned_interpolator/1",
            "robot": self.law.robot,
            "file": str(self.path),
            "parameters": asdict(self.law.parameters),
            "settling_s": self.law.settling_s,
            "stretches": self.stretches,
            **self.law.figures,
        }


def learn_files(robot: str, paths: Sequence[Path], out: Path, console: Console) -> Learned:
    """Learn the law from logs with set-points, and write it.

    Args:
        robot: name or file of its description.
        paths: of logs with set-points.
        out: file of the law.
        console: where progress is shown.

    Raises:
        InputError: logs without set-points, without motion or without their program, logs of another robot or of
            several, or logs that do not follow the program.
    """
    check_output(out, paths)
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{out}: name a .yaml file; search.interpolator of a recipe needs that ending")
    description = load_robot(robot)
    logs = read_logs(list(paths), description, console)
    check_one_machine(logs, None, False)
    stretches: dict[Any, RecordedMove] = {}
    rests: dict[str, list[float]] = {}
    for log in logs:
        _check_log(log, description)
        for key, stretch in _stretches(log, _statements(log, description), description, rests):
            stretches.setdefault(key, stretch)
    if not stretches:
        raise InputError(f"{logs[0].path}: no stretch between two stops is whole; record one loop without gaps")
    chosen = sorted(stretches.values(), key=lambda rms: -float(rms.t[-1] - rms.t[0]))[:_MAX_MOVES]
    learner = Learner(description, chosen, 1.0 / logs[0].sample_rate)
    try:
        parameters = learner.learn(lambda text: console.step(f"learning from {len(chosen)} stretches: {text}"))
        before, after = learner.errors(FlyParameters()), learner.errors(parameters)
    except MotionError as error:
        raise InputError(f"{logs[0].path}: the program cannot be planned: {error}") from None
    content = {
        "schema": "interpolator/1",
        "robot": description.name,
        "robot_digest": robot_digest(description),
        "parameters": parameters,
        "settling_s": {word: round(float(np.median(seconds)), 4) for word, seconds in sorted(rests.items())},
        "figures": {
            name: {"path_mm": round(rms.path, 4), "time_percent": round(rms.time, 4)}
            for name, rms in (("before", before), ("after", after))
        },
        "logs": [{"log": log.name, "sha256": log.sha256} for log in logs],
    }
    law = LearnedLaw.model_validate(content, from_attributes=True)
    write_atomically(out, law.text())
    return Learned(law, out, len(chosen))


def _check_log(log: Log, robot: RobotDescription) -> None:
    named = log.metadata.get("robot", robot.name)
    if named != robot.name:
        raise InputError(f"{log.path}: a log of {named}, and the robot is {robot.name}; name that robot with --robot")
    if log.reference_position is None:
        raise InputError(
            f"{log.path}: has no /joint_references, the controller's set-points, and measured positions follow them "
            "too late to learn from; record with a driver that delivers set-points"
        )
    good = np.isfinite(log.reference_position).all(axis=1)
    if not good.any() or np.ptp(log.reference_position[good], axis=0).max() < _THERE:
        raise InputError(f"{log.path}: the set-points do not move; record a loop")


def _statements(log: Log, robot: RobotDescription) -> list[Statement]:
    """Statements of the recorded program: a file with the log's name next to it, or the program of its run."""
    pdl2 = create_dialect("pdl2")  # the language of the controllers whose law is learned
    named = log.path.with_suffix(pdl2.suffix)
    of_run = log.path.with_name(f"program{pdl2.suffix}")
    chosen = named if named.is_file() else of_run if log.path.stem == "excitation" and of_run.is_file() else None
    if chosen is None:
        return list(pdl2.read(_of_the_plan(log), str(log.path), robot).run())
    return list(pdl2.read(read_text(chosen, LARGEST_PROGRAM), str(chosen), robot).run())


def _of_the_plan(log: Log) -> str:
    """Program of a validation motion, from the plan of its run."""
    folder = log.path.parent
    if (folder / "plan.json").is_file() and (folder / "state.json").is_file():
        recipe = recipe_of(folder)
        for number, motion in enumerate(replan(recipe, folder / "plan.json").validation, 1):
            if log.path.stem == f"validation_{number:02d}":
                return motion.program
    raise InputError(
        f"{log.path}: the recorded program is missing; put it next to the log as {log.path.stem}.pdl "
        "(a run folder has it)"
    )


def _stretches(
    log: Log, statements: Sequence[Statement], robot: RobotDescription, rests: dict[str, list[float]]
) -> list[tuple[Any, RecordedMove]]:
    """Motions between stops by their key; adds the duration of each stop to `rests` [s]."""
    tool = log.metadata.get("tool", "none")
    if tool != "none" and any(
        isinstance(statement, Move) and statement.settings.tool is None for statement in statements
    ):
        raise InputError(
            f"{log.path}: its program leaves $TOOL open, and the log was recorded with {tool}; "
            "record a program that sets it"
        )
    reference = log.reference_position
    assert reference is not None
    good = np.isfinite(reference).all(axis=1)
    t, q = log.t[good], reference[good]
    moving = moving_segments(q, max(2, round(SHORTEST_STOP * log.sample_rate)))
    interpolator = FlyInterpolator(robot, period=1.0 / log.sample_rate)
    stretches: list[tuple[Any, RecordedMove]] = []
    at, stand, last_stop = 0, q[0], None
    for moves, waited in _chains(statements):
        planned = interpolator.plan(moves, stand).q
        if np.ptp(planned, axis=0).max() < _THERE:
            continue
        distance = float(np.abs(np.diff(planned, axis=0)).sum())
        for last in range(at, len(moving)):
            a, b = moving[at][0], moving[last][1]
            done = float(np.abs(np.diff(q[a:b], axis=0)).sum())
            if np.abs(q[b - 1] - planned[-1]).max() < _THERE and _SHORTER * distance < done < _LONGER * distance:
                break
        else:
            since = t[moving[at][0]] if at < len(moving) else t[-1]
            raise InputError(
                f"{log.path}: the set-points do not follow the program: after {since:.2f} s the arm does not come to "
                f"{moves[-1].name or 'the next stop'}; is it the program that was recorded?"
            )
        if last_stop is not None and waited == 0.0:
            rests.setdefault(last_stop[0], []).append(float(t[a] - last_stop[1]))
        even = np.diff(t[a:b]).max() <= 2.5 / log.sample_rate
        if even:
            stretches.append((way_key(moves), RecordedMove(tuple(moves), t[a:b], q[a:b])))
        last_stop = Pdl2Settings.of(moves[-1].settings).termination.value, float(t[b - 1])
        at, stand = last + 1, q[b - 1]
        if at == len(moving):
            break
    return stretches


def _chains(statements: Sequence[Statement]) -> list[tuple[list[Move], float]]:
    """Moves from stop to stop, each with the DELAY [s] before it."""
    chains: list[tuple[list[Move], float]] = []
    pending: list[Move] = []
    waited = 0.0
    for statement in statements:
        if isinstance(statement, Delay):
            waited += statement.seconds
        elif isinstance(statement, Move):
            pending.append(statement)
            if not statement.fly:
                chains.append((pending, waited))
                pending, waited = [], 0.0
    return [*chains, (pending, waited)] if pending else chains
