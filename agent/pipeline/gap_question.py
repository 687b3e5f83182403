"""What is asked of logs by `agent diagnose`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from agent.core import InputError
from agent.pipeline.corrected_simulator import check_simulator_out
from agent.pipeline.identify import check_output

#: Time for planning a further motion [s], where nobody says how much.
PLANNING_BUDGET = 60.0


@dataclass(frozen=True)
class GapQuestion:
    """What is asked of logs: against which model (None: one fitted to them), what is left out, what is written.

    `model` is a model file, an MJCF or a URDF; `joint_map` says how joints of the latter two are called in the logs.
    `report` is the page, `out` the file of the model with the effects found, or of the simulator corrected (its own
    format); None: neither. `allow_mixed`: logs and
    model may be of several machines or tools; `force`: go on although a log is implausible. `next_recipe`: where the
    motion that tells more may lie; then `out` is the folder for it, and `next_payload` a known mass for it.
    `drives_off` is a log of the arm at rest with its drives off. `topic` holds the joint states of the logs. Planning
    takes at most `planning_budget` [s].
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
    planning_budget: float = PLANNING_BUDGET

    def options(self) -> list[str]:
        """The words of `agent diagnose` that ask the same; with which logs, or what to record, comes beside them."""
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
        }
        words = [word for option, value in named.items() if value is not None for word in (option, str(value))]
        if self.planning_budget != PLANNING_BUDGET:
            words += ["--planning-budget", f"{self.planning_budget:g} s"]
        words += [word for effect in self.without for word in ("--without", effect)]
        flags = {"--allow-mixed": self.allow_mixed, "--force": self.force}
        return [*words, *(flag for flag, given in flags.items() if given)]

    def check(self, logs: Sequence[Path]) -> None:
        """What makes no sense is refused before the work, and before anything moves.

        Raises:
            InputError: an output that cannot be written or would overwrite an input, an unknown effect, or no model.
        """
        from agent.diagnosis import check_effects

        check_effects(self.without)
        if self.drives_off is not None and self.drives_off.absolute() in [log.absolute() for log in logs]:
            raise InputError(
                f"{self.drives_off}: is named both as a motion and with --drives-off; name a log of the "
                "stationary arm with --drives-off"
            )
        inputs = [*logs, *(path for path in (self.model, self.joint_map, self.drives_off) if path)]
        if self.next_payload is not None:
            from agent.model import payload_of

            if self.next_recipe is None:
                raise InputError("diagnose: --payload belongs to the motion of --next: name its recipe with --next")
            payload_of(self.next_payload)
        if self.next_recipe is not None:
            from agent.pipeline.next_checks import check_next

            check_next(self.next_recipe, self.out, self.next_payload)
        files = (self.report, None if self.next_recipe is not None else self.out)
        for out in files:
            if out is not None:
                check_output(out, inputs)
        if self.report is not None and self.report in files[1:]:
            raise InputError(f"{self.out}: is both page and model; name two files")
        if self.out is not None and self.next_recipe is None:
            check_simulator_out(self.model, self.out, inputs)
