"""Program languages of controllers: each vendor's dialect behind one interface.

A program is data (`agent.motion.program`: moves with targets, speeds and blend distances). A dialect turns it into the
text of a vendor's language and back. To add one:

1. Make a folder next to `pdl2` with a class that has the members of `Dialect`, and name it in `agent.motion.registry`.
2. If a move needs settings that only that vendor has, derive a class from `MotionSettings`, or from `PathSettings`
   where it says how paths are blended. Writer and interpolator call its `of`, so a program read in one dialect runs in
   another.
3. Name the interpolation law of its controllers there too; `Dialect.interpolators` lists its laws.
4. Give the drivers of those controllers a class attribute `dialect` with the dialect's name (`drivers.registry`).

A recipe's dialect follows from its driver: `Recipe.dialect`. A program that a person names (`via_points.like`) is read
in the dialect of its suffix: `dialect_of`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from agent.motion.program import LoopProgram, MotionSettings, Statement

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class ReadProgram(Protocol):
    """A program that was read and checked."""

    @property
    def name(self) -> str:
        """What the program calls itself."""

    def run(self) -> Iterator[Statement]:
        """Its moves and delays in order, loops unrolled as they are reached; SI units.

        Raises:
            InputError: while iterating, where a statement cannot be executed.
        """


class Dialect(Protocol):
    """A vendor's program language. Instances hold nothing; texts are in the vendor's units, all else is SI."""

    name: str
    """As drivers declare it: `pdl2`."""
    suffix: str
    """Of its program files: `.pdl`."""
    comment: str
    """What begins a comment that ends with the line: `--`."""
    interpolators: tuple[str, ...]
    """Laws of its controllers (`agent.motion.registry`); the first is used where a recipe names none."""
    fly_keys: frozenset[str]
    """Keys of a recipe's `motion.fly` that the language can say; `distance` is always one."""
    frame_names: Mapping[str, str]
    """Fields of `MotionSettings` (`base`, `tool`, `uframe`) and what programs, messages and `Driver.frames` call them.
    A frame that the language does not have is left out; what it reads has `NO_FRAME` there."""

    def settings(self, fly: Mapping[str, Any], speed: float, robot: RobotDescription) -> MotionSettings:
        """Settings of a recipe's loop: its `motion.fly` (`fly_keys` only) and `motion.speed` [m/s]."""

    def write(self, name: str, statements: Sequence[Statement], robot: RobotDescription | None = None) -> str:
        """A program that makes these moves and delays once; `read` gives them back, and the writer has checked that.

        Raises:
            InputError: a name, a setting or a coordinate that the language does not take.
        """

    def write_loop(self, name: str, loop: LoopProgram, robot: RobotDescription | None = None) -> str:
        """A program of a loop; the arm may rest where it stops.

        Raises:
            InputError: what `write` refuses.
        """

    def read(self, text: str, path: str = "", robot: RobotDescription | None = None) -> ReadProgram:
        """Read and check a program of the motion subset; `path` is named in messages.

        Raises:
            InputError: not of the subset, or not for this robot: names path, line and column.
        """

    def job(
        self, text: str, path: str = "", robot: RobotDescription | None = None, companion: str = ""
    ) -> tuple[str, dict[str, int]]:
        """A person's program reduced to what moves, so that `read` takes it, and how often each word that does not
        move was passed over. `companion` is the text of the file that `companion` names.

        Raises:
            InputError: something moves that is not understood.
        """

    def companion(self, program: Path) -> Path | None:
        """The file next to a program that its positions come from, where the language has one and it is there."""

    def messages(self, text: str) -> dict[str, str]:
        """Further files of a program, by name, for whoever sends it without the agent; most languages need none."""
