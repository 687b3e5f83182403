"""Unattended motion: a person's written permission for motions that run while nobody is there.

The file is read, never written, by the agent:

    robot: comau_ns16
    serial: NS16-0042
    program: 3f1c…            # SHA-256 of the program, as `agent trajectories` shows it
    problem: 90ab…            # and of what it was planned with (robot, URDF, tool, cell, sub-region, motion)
    limits: {speed: 1 m/s, duration: 20 min}
    new_motions: {duration: 10 min}   # optional: motions that nobody has seen, see `NewMotions`
    expires: 2027-03-31       # the last day, UTC
    written_by: M. Rossi
"""

from __future__ import annotations

import stat
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from agent.core import InputError, load_document
from agent.recipe import Name, Speed, Time

#: Nobody knows what a cell looks like in two years: a file that allows more is refused.
LONGEST = timedelta(days=366)
#: Time before the end of an authorisation from which a run warns.
_SOON = timedelta(days=14)


class _AuthorisedPart(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Limits(_AuthorisedPart):
    """Highest speed of the tool centre point [m/s] and longest motion [s] that may run."""

    speed: Annotated[Speed, Field(gt=0)]
    duration: Annotated[Time, Field(gt=0)]


class NewMotions(_AuthorisedPart):
    """Motions that a run plans by itself in the problem's sub-region, with a limit on their total duration [s].

    Each of them keeps the limits too, and the speed of a first run, as nobody has seen it.
    """

    duration: Annotated[Time, Field(gt=0)]


class AuthorisationDocument(_AuthorisedPart):
    """The file as it is written."""

    robot: Name
    serial: Name
    program: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    problem: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    limits: Limits
    new_motions: NewMotions | None = None
    expires: date
    written_by: Name


@dataclass(frozen=True)
class Authorisation:
    """A person permits, in the file `path`, that one program runs on one machine, within limits, until a day ends.

    `unseen`: the program was planned by this run, and nobody has watched it (`for_new_motion`).
    """

    path: Path
    document: AuthorisationDocument
    unseen: bool = False

    def check(
        self, robot: str, serial: str, program: str, speed: float, duration: float, now: datetime | None = None
    ) -> None:
        """The motion that is about to start is the one that was authorised.

        Args:
            program: SHA-256 (hex) of the program as the controller stores it.
            speed: highest planned speed of the tool centre point [m/s]; duration: of the whole motion [s].

        Raises:
            InputError: it is not; everything that differs is listed.
        """
        document, limits = self.document, self.document.limits
        faults = []
        if robot != document.robot:
            faults.append(f"it is for {document.robot}, the controller drives {robot}")
        if serial != document.serial:
            faults.append(f"it is for serial {document.serial}, this machine is {serial}")
        if program != document.program:
            faults.append(f"it is for program {document.program[:12]}…, what would run is {program}")
        if not speed <= limits.speed * (1 + 1e-9):
            faults.append(f"the motion reaches {speed:.3f} m/s, {limits.speed:g} m/s are allowed")
        if not duration <= limits.duration:
            faults.append(f"the motion takes {duration:.0f} s, {limits.duration:.0f} s are allowed")
        if not (now or datetime.now(UTC)).date() <= document.expires:
            faults.append(f"it ended on {document.expires}")
        if faults:
            raise InputError(
                f"{self.path}: this authorisation does not cover the motion: {'; '.join(faults)}. Nothing was moved; "
                "somebody who knows the cell has to write a new one"
            )

    def check_problem(self, problem: str) -> None:
        """The loop was planned with the robot, tool, cell and motion settings that were authorised.

        Args:
            problem: SHA-256 (hex) of all of them, as `agent.runs.approved` makes it.

        Raises:
            InputError: it was not.
        """
        if problem != self.document.problem:
            raise InputError(
                f"{self.path}: this authorisation is for problem {self.document.problem[:12]}…, this recipe, its robot "
                f"and cell make {problem}. Nothing was moved; somebody who knows the cell has to write a new one"
            )

    def for_new_motion(self, problem: str, program: str, before: float) -> Authorisation:
        """The same for one program that was planned in the problem's sub-region; it can be stricter, never wider.

        Args:
            problem: as in `check_problem`; program: as in `check`.
            before: how long the new motions of this run before it were [s].

        Raises:
            InputError: new motions are not released, are of another problem, or their time is used up.
        """
        released = self.document.new_motions
        if released is None:
            raise InputError(
                f"{self.path}: this authorisation is for the stored loop; it releases no new motions (new_motions)"
            )
        self.check_problem(problem)
        remaining = released.duration - before
        if not remaining > 0:
            raise InputError(f"{self.path}: the {released.duration:.0f} s of new motions that it allows are used up")
        limits = self.document.limits.model_copy(update={"duration": min(self.document.limits.duration, remaining)})
        document = self.document.model_copy(update={"program": program, "limits": limits})
        return replace(self, document=document, unseen=True)

    def ends_soon(self, now: datetime | None = None) -> str | None:
        """Warning if it ends within two weeks."""
        remaining = self.document.expires - (now or datetime.now(UTC)).date()
        return f"{self.path}: this authorisation ends on {self.document.expires}" if remaining <= _SOON else None


def load_authorisation(path: Path, now: datetime | None = None) -> Authorisation:
    """Read an authorisation.

    Raises:
        InputError: missing or wrong, writable by others than its owner, or valid for more than a year.
    """
    document = load_document(path, AuthorisationDocument)
    if path.stat().st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise InputError(f"{path}: others than its owner can write this authorisation; chmod go-w {path}")
    latest = ((now or datetime.now(UTC)) + LONGEST).date()
    if not document.expires <= latest:
        raise InputError(f"{path}: expires: {document.expires} is more than a year from now; {latest} is the latest")
    return Authorisation(path, document)
