"""Record, diagnose, plan, record: until the cause is settled, or nothing within the budget would settle it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from agent.core import Console, sha256_text, words_of
from agent.diagnosis import could_show
from agent.experiment import LONGEST, Deadline, NoMotion
from agent.link import Recording, open_link
from agent.pipeline.gap.diagnosis_question import SHORTEST
from agent.pipeline.gap.diagnosis_run import DiagnosisRun
from agent.pipeline.gap.next_experiment import plan_next
from agent.pipeline.job import Job
from agent.recording import PARTS, PLANNED_PARTS
from agent.runs import run_key
from agent.safety import FIRST_SPEED


@dataclass
class Rounds:
    """Further motions and what they found.

    Attributes
    ----------
    logs : logs of the motions that count.
    asked : `rounds` of a result, one entry per motion.
    last : diagnosis of all logs that count.
    recipe : where the motions lie.
    end : why no further motion followed.
    other : what else may settle the cause.
    cut_short : the error that ended the last round.
    uncounted : log of a round that was cut short after it was recorded.
    """

    logs: list[Path]
    asked: list[dict[str, Any]]
    last: DiagnosisRun
    recipe: Path
    end: str = ""
    other: NoMotion | None = None
    cut_short: BaseException | None = None
    uncounted: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """Keys of a result: `rounds`, `rounds_end`, and `next_experiment` where something else may settle it."""
        other = {} if self.other is None else {"next_experiment": self.other.to_dict()}
        return {"rounds": self.asked, "rounds_end": self.end, **other}


def until_sure(
    find: Callable[[Sequence[Path]], DiagnosisRun],
    logs: Sequence[Path],
    job: Job,
    budget: float,
    planning: float = float("inf"),
) -> Rounds:
    """Record further motions into the run folder as `experiment_01.mcap`, … until the cause is settled.

    Whatever cuts a round short, such as a lost link, Ctrl-C or an implausible log, is part of what is returned, after
    a controlled stop: the earlier results are not lost.

    Parameters
    ----------
    find : diagnosis of logs; all earlier ones count in every round.
    job : where the motions lie; motions that it is allowed while nobody is there are as slow as a first run.
    budget : longest further motion [s].
    planning : longest time for planning each motion [s].

    Raises
    ------
    AgentError : the first logs cannot be diagnosed, or the recipe allows no motion.
    """
    recipe, console, allowed = job.recipe, job.console, job.allowed
    rounds, moved, slow = Rounds([], [], find(logs), recipe.path), 0.0, recipe
    if allowed is not None:
        fastest = 0.98 * min(recipe.motion.speed, FIRST_SPEED, allowed.document.limits.speed)
        slow = replace(recipe, motion=replace(recipe.motion, settings=recipe.motion.settings_at(fastest)))
    while not (end := _end(rounds, budget - moved, console)):
        name = f"experiment_{len(rounds.asked) + 1:02d}"
        recording: Recording | None = None
        try:
            deadline = Deadline(console.progress, planning)
            seconds = min(LONGEST, budget - moved)
            motion = plan_next(rounds.last.diagnosis, slow, console, seconds, name, deadline=deadline)
            if isinstance(motion, NoMotion):
                end, rounds.other = motion.text, motion
                break
            program = job.run.write_text(f"{name}{recipe.dialect.suffix}", motion.text).name
            entry = replace(motion, brakes=False).to_dict(program)  # no log on the brakes was requested
            verdict = rounds.last.result["verdict"]
            rounds.asked.append({"after": verdict, **entry, "verdict": None, "causes": []})
            word = allowed and allowed.for_new_motion(run_key(recipe)["loop"], sha256_text(motion.text), moved)
            with open_link(recipe, console, job.yes, job.logs, word, facts={PARTS: PLANNED_PARTS}) as link:
                recording = job.record_program(link, motion.text, program, "experiment", f"{name}.mcap", name)
            moved += recording.duration
            rounds.last = find([*logs, *rounds.logs, recording.path])
            rounds.logs.append(recording.path)
        except BaseException as error:
            rounds.end, rounds.cut_short = f"cut short: {words_of(error)}", error
            rounds.uncounted = None if recording is None else recording.path
            return rounds
    rounds.end = end
    console.say(end)
    return rounds


def _end(rounds: Rounds, remaining: float, console: Console) -> str:
    """Note what the last round found; returns why no further one follows, if so, with `remaining` [s] of the budget."""
    result = rounds.last.result
    verdict = result["verdict"]
    if rounds.asked:
        causes = [{key: cause[key] for key in ("effect", "joints", "probability")} for cause in result["causes"]]
        rounds.asked[-1] |= {"verdict": verdict, "causes": causes}
        console.say(f"round {len(rounds.asked)}: {verdict}")
    if verdict == "explained" or (verdict == "no_gap" and could_show(result)):
        absorbed = verdict == "no_gap" and not rounds.last.diagnosis.dataset.has_reference
        beyond = ". A model fitted to these logs can hide a gap: name an earlier model with --model"
        return f"settled: {verdict}{beyond if absorbed else ''}"
    if remaining < SHORTEST:
        return (
            f"the motion budget is used up: {max(remaining, 0.0):.0f} s are left, and a motion takes "
            f"{SHORTEST:g} to {LONGEST:g} s"
        )
    return ""
