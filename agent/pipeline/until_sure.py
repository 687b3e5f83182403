"""Record, diagnose, plan, record: until what is open is settled, or nothing within the budget would settle it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import Bare, Console, Dimension, InputError, parse_quantity, sha256_text, words_of
from agent.link import Recording, open_link
from agent.pipeline.next_experiment import LONGEST, NoMotion, plan_next
from agent.pipeline.record_plan import record_program
from agent.recipe import Recipe
from agent.runs import RunFolder, run_key
from agent.safety import FIRST_SPEED, Authorisation

if TYPE_CHECKING:
    from agent.diagnosis import Diagnosis, Simulated
    from agent.simulators import Simulator

    #: A diagnosis, what it says in simulation, and the simulator's file that was read.
    Found = tuple[Diagnosis, list[Simulated], Simulator | None]

#: Motion that is allowed where nobody says how much.
BUDGET = "10 min"
#: With less motion left than this [s] no further one is planned.
_SHORTEST = 10.0
_LONGEST = 4 * 3600.0


def time_of(option: str, text: str, bare: Bare) -> float:
    """Seconds, from what an option says.

    Raises:
        InputError: not a time.
    """
    try:
        return parse_quantity(text, Dimension.TIME, bare)
    except InputError as error:
        raise InputError(f"{option}: {error}") from None


def budget_of(text: str) -> float:
    """Seconds of motion, from what `--budget` says.

    Raises:
        InputError: not a time, or too short for a motion.
    """
    seconds = time_of("--budget", text, Bare("min", least=60.0))
    if not _SHORTEST <= seconds <= _LONGEST:
        raise InputError(f"--budget {text}: {_SHORTEST:g} s to {_LONGEST / 3600:g} h of motion are allowed")
    return seconds


def planning_time(text: str) -> float:
    """Seconds of planning, from what `--planning-budget` says.

    Raises:
        InputError: not a time, or less than a second.
    """
    seconds = time_of("--planning-budget", text, Bare("s", least=1.0))
    if seconds < 1:
        raise InputError(f"--planning-budget {text}: at least 1 s is needed")
    return seconds


def options_of(budget: float | None) -> list[str]:
    """The words of a command line that allow so much motion [s]; None: no further motion, no words."""
    return [] if budget is None else ["--until-sure", "--budget", f"{budget:g} s"]


@dataclass
class Rounds:
    """What further motions asked and found: their logs, a dict for each round as `rounds` of a result has them, what
    all logs together were found to say, why no further one followed, what else may settle it (`other`, if anything),
    and what cut the last one short. `uncounted` is the log of a round that was cut short once it was recorded, `recipe`
    where further motions may lie."""

    logs: list[Path]
    asked: list[dict[str, Any]]
    last: Found
    recipe: Path
    end: str = ""
    other: NoMotion | None = None
    cut_short: BaseException | None = None
    uncounted: Path | None = None

    @property
    def said(self) -> str:
        """The verdict of all that counts, and its causes, in a line."""
        from agent.report import in_short

        return in_short(self.last[0].result)

    def to_dict(self) -> dict[str, Any]:
        """Keys of a result: `rounds`, `rounds_end`, and `next_experiment` where something else may settle it."""
        other = {} if self.other is None else {"next_experiment": self.other.to_dict()}
        return {"rounds": self.asked, "rounds_end": self.end, **other}


def until_sure(
    find: Callable[[Sequence[Path]], Found],
    logs: Sequence[Path],
    recipe: Recipe,
    run: RunFolder,
    console: Console,
    runs: Path,
    yes: bool,
    budget: float,
    allowed: Authorisation | None = None,
    planning: float = float("inf"),
) -> Rounds:
    """Record further motions into the run folder as `experiment_01.mcap`, … until what is open is settled.

    Whatever cuts a round short, a lost link as much as Ctrl-C or a log that cannot be, is in what is returned, after a
    controlled stop: what was found until then is not lost.

    Args:
        find: the diagnosis of logs; all earlier ones count in every round.
        budget: further motion that is allowed [s].
        allowed: a person's word, where nobody is there; motions are then as slow as a first run.
        planning: time for planning each of them [s].

    Raises:
        AgentError: first logs that cannot be diagnosed, or a recipe that leaves no room.
    """
    from agent.experiment import Deadline
    from agent.recording import PARTS, PLANNED_PARTS

    rounds, moved, slow = Rounds([], [], find(logs), recipe.path), 0.0, recipe
    if allowed is not None:
        fastest = 0.98 * min(recipe.motion.speed, FIRST_SPEED, allowed.document.limits.speed)
        slow = replace(recipe, motion=replace(recipe.motion, settings=recipe.motion.settings_at(fastest)))
    while True:
        result = rounds.last[0].result
        if rounds.asked:
            rounds.asked[-1] |= {"verdict": result["verdict"], "causes": [_named(cause) for cause in result["causes"]]}
            console.say(f"round {len(rounds.asked)}: {result['verdict']}")
        if result["verdict"] in ("explained", "no_gap"):
            absorbed = result["verdict"] == "no_gap" and not rounds.last[0].dataset.given
            beyond = ". A model fitted to these logs can hide a gap: name an earlier model with --model"
            rounds.end = f"settled: {result['verdict']}{beyond if absorbed else ''}"
        elif budget - moved < _SHORTEST:
            rounds.end = (
                f"the motion budget is used up: {max(budget - moved, 0.0):.0f} s are left, and a motion takes "
                f"{_SHORTEST:g} to {LONGEST:g} s"
            )
        if rounds.end:
            break
        name = f"experiment_{len(rounds.asked) + 1:02d}"
        recording: Recording | None = None
        try:
            deadline = Deadline(console.progress, planning)
            seconds = min(LONGEST, budget - moved)
            motion = plan_next(rounds.last[0], slow, console, seconds, name, deadline=deadline)
            if isinstance(motion, NoMotion):
                rounds.end, rounds.other = motion.text, motion
                break
            program = run.write_text(f"{name}{recipe.dialect.suffix}", motion.text).name
            ran = replace(motion, brakes=False).to_dict(program)  # nobody was asked for seconds on the brakes
            rounds.asked.append({"after": result["verdict"], **ran, "verdict": None, "causes": []})
            word = allowed and allowed.for_new_motion(run_key(recipe)["loop"], sha256_text(motion.text), moved)
            with open_link(recipe, console, yes, runs, word, facts={PARTS: PLANNED_PARTS}) as link:
                log = f"{name}.mcap"
                recording = record_program(link, run, recipe, console, motion.text, program, "experiment", log, name)
            moved += recording.duration
            rounds.last = find([*logs, *rounds.logs, recording.path])
            rounds.logs.append(recording.path)
        except BaseException as error:
            rounds.end, rounds.cut_short = f"cut short: {words_of(error)}", error
            rounds.uncounted = None if recording is None else recording.path
            return rounds
    console.say(rounds.end)
    return rounds


def _named(cause: Mapping[str, Any]) -> dict[str, Any]:
    return {key: cause[key] for key in ("effect", "joints", "probability")}
