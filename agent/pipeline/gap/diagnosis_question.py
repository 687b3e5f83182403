"""The question to `agent diagnose`, and the command line that asks the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.core import Bare, Dimension, InputError, parse_quantity
from agent.diagnosis import check_effects
from agent.model import payload_of
from agent.pipeline.gap.corrected_output import check_simulator_out
from agent.pipeline.gap.next_experiment import check_next
from agent.runs import check_output

#: Default of `--planning-budget` [s], and of `--budget`.
PLANNING_BUDGET = 60.0
BUDGET = "10 min"
#: Limits of `--budget` [s]: with less motion left, no further one is planned.
SHORTEST, _LONGEST = 10.0, 4 * 3600.0


@dataclass(frozen=True)
class GapQuestion:
    """Question to a diagnosis: model to compare with, what to leave out, and what to write.

    Attributes
    ----------
    model : model file, MJCF or URDF to compare with; None: a model fitted to the logs.
    joint_map : names of the joints of an MJCF or URDF in the logs.
    cutoff : cut-off frequency of the torque filter [Hz].
    without : effects to ignore.
    report : HTML page to write.
    out : model or corrected simulator to write; with `next_recipe`, the folder of the planned motion.
    allow_mixed : logs and model may be of several machines or tools.
    force : continue although a log is implausible.
    next_recipe : recipe in whose sub-region a further motion is planned.
    next_payload : known mass at the flange for that motion.
    drives_off : log of the stationary arm with its drives off.
    topic : topic of the joint states in the logs.
    effort : what the effort of the logs is; None: as their driver says it, or torque.
    known : numbers of the simulator's servos that are right: `kp`.
    planning_budget : longest time for planning [s].
    """

    model: Path | None = None
    joint_map: Path | None = None
    cutoff: float | None = None
    without: tuple[str, ...] = ()
    report: Path | None = None
    out: Path | None = None
    allow_mixed: bool = False
    force: bool = False
    next_recipe: Path | None = None
    next_payload: str | None = None
    drives_off: Path | None = None
    topic: str | None = None
    effort: str | None = None
    known: tuple[str, ...] = ()
    planning_budget: float = PLANNING_BUDGET

    def options(self) -> list[str]:
        """Options of `agent diagnose` that ask the same; the logs or the recipe to record are not among them."""
        named = {
            "--model": self.model,
            "--map": self.joint_map,
            "--cutoff": self.cutoff,
            "--report": self.report,
            "--out": self.out,
            "--next": self.next_recipe,
            "--payload": self.next_payload,
            "--drives-off": self.drives_off,
            "--topic": self.topic,
            "--effort": self.effort,
        }
        words = [word for option, value in named.items() if value is not None for word in (option, str(value))]
        if self.planning_budget != PLANNING_BUDGET:
            words += ["--planning-budget", f"{self.planning_budget:g} s"]
        words += [word for effect in self.without for word in ("--without", effect)]
        words += [word for number in self.known for word in ("--known", number)]
        flags = {"--allow-mixed": self.allow_mixed, "--force": self.force}
        return [*words, *(flag for flag, is_set in flags.items() if is_set)]

    def check(self, logs: Sequence[Path]) -> None:
        """Refuse what makes no sense before the work, and before anything moves.

        Raises:
            InputError: an output that cannot be written or would overwrite an input, an unknown effect, or no model.
        """
        check_effects(self.without)
        if unknown := [number for number in self.known if number != "kp"]:
            raise InputError(f"diagnose: --known {unknown[0]}: only kp can be known, the gain of the file's servos")
        if self.drives_off is not None and self.drives_off.absolute() in [log.absolute() for log in logs]:
            raise InputError(
                f"{self.drives_off}: is named both as a motion and with --drives-off; name a log of the "
                "stationary arm with --drives-off"
            )
        if self.next_payload is not None:
            if self.next_recipe is None:
                raise InputError("diagnose: --payload belongs to the motion of --next: name its recipe with --next")
            payload_of(self.next_payload)
        if self.next_recipe is not None:
            check_next(self.next_recipe, self.out, self.next_payload)
        inputs = [*logs, *(path for path in (self.model, self.joint_map, self.drives_off) if path)]
        written = None if self.next_recipe is not None else self.out
        for out in (self.report, written):
            if out is not None:
                check_output(out, inputs)
        if self.report is not None and self.report == written:
            raise InputError(f"{self.out}: is both page and model; name two files")
        if written is not None:
            check_simulator_out(self.model, written, inputs)


def budget_of(text: str) -> float:
    """Seconds of motion from the value of `--budget`.

    Raises:
        InputError: not a time, or too short for a motion.
    """
    seconds = _seconds("--budget", text, Bare("min", least=60.0))
    if not SHORTEST <= seconds <= _LONGEST:
        raise InputError(f"--budget {text}: {SHORTEST:g} s to {_LONGEST / 3600:g} h of motion are allowed")
    return seconds


def planning_time(text: str) -> float:
    """Seconds of planning from the value of `--planning-budget`.

    Raises:
        InputError: not a time, or less than a second.
    """
    seconds = _seconds("--planning-budget", text, Bare("s", least=1.0))
    if seconds < 1:
        raise InputError(f"--planning-budget {text}: at least 1 s is needed")
    return seconds


def options_of(budget: float | None) -> list[str]:
    """Options that allow this much further motion [s]; none for None."""
    return [] if budget is None else ["--until-sure", "--budget", f"{budget:g} s"]


def _seconds(option: str, text: str, bare: Bare) -> float:
    try:
        return parse_quantity(text, Dimension.TIME, bare)
    except InputError as error:
        raise InputError(f"{option}: {error}") from None
