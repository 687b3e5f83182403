"""Scenarios: small text files that say what the fake is, what goes wrong when, and how it must end."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from agent.core import InputError, load_document
from agent.recipe import Time
from agent.robot import load_robot
from fake_controller.faults import Fault
from fake_controller.servers import IMPOSSIBLE, WIRES
from fake_controller.state import State

#: Those that come with the package.
FOLDER = Path(__file__).parent / "scenarios"


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class SetupSection(_Section):
    """The controller; `effects` as `fake_controller.actuation.load_effect` takes them."""

    robot: str = "comau_ns16"
    seed: Annotated[int, Field(ge=0)] = 7
    clock: Literal["fast", "real"] = "fast"
    state: State = State()
    effects: tuple[dict[str, Any], ...] = ()


class FaultSection(_Section):
    """One fault; `Fault` has the meaning of the keys. A joint may be given by name."""

    fault: str
    phase: str
    after: Time = 0.0
    value: Annotated[float, Field(ge=0)] = 0.0
    joint: Annotated[int, Field(ge=1)] | str = 1

    @model_validator(mode="after")
    def _makes_sense(self) -> FaultSection:
        self.build(1)
        return self

    def build(self, joint: int) -> Fault:
        """The fault itself, on a joint by number."""
        return Fault(self.fault, self.phase, self.after, self.value, joint)


class ExpectSection(_Section):
    """How `agent record` must end: its exit code, the number of started motions, and the remaining files."""

    exit_code: int = 0
    motions: Annotated[int, Field(ge=0)] = 1
    controlled_stop: bool = True
    log_readable: bool = True


class Scenario(_Section):
    """The whole file. `interrupt`: time of motion before Ctrl-C, if the fault strikes on the stop.

    `expect` is for the tests; by hand it may be left out. `elsewhere` has the wires, by name, on which it ends in
    another way than on most.
    """

    title: str
    setup: SetupSection = SetupSection()
    faults: tuple[FaultSection, ...] = ()
    interrupt: Time | None = None
    expect: ExpectSection = ExpectSection()
    elsewhere: dict[str, ExpectSection] = {}

    @field_validator("elsewhere")
    @classmethod
    def _wires_there_are(cls, value: dict[str, ExpectSection]) -> dict[str, ExpectSection]:
        for wire in value:
            if wire not in WIRES:
                raise ValueError(f"there is no wire {wire!r}; there are {', '.join(WIRES)}")
        return value

    @property
    def wires(self) -> list[str]:
        """Wires on which all of its faults are possible."""
        return [wire for wire in WIRES if not any(section.fault in IMPOSSIBLE[wire] for section in self.faults)]

    def expected(self, wire: str) -> ExpectSection:
        """How it must end on this wire."""
        return self.elsewhere.get(wire, self.expect)

    def build_faults(self, robot: str | None = None) -> list[Fault]:
        """The faults themselves, of the `robot` where another one is named than in the file.

        Raises:
            InputError: the robot has no joint of that name.
        """
        faults = []
        for section in self.faults:
            joint = section.joint
            if isinstance(joint, str):
                names = load_robot(robot or self.setup.robot).joint_names
                if joint not in names:
                    raise InputError(f"faults: joint: there is no {joint!r}; there are {', '.join(names)}")
                joint = 1 + names.index(joint)
            faults.append(section.build(joint))
        return faults


def load_scenario(path: Path) -> Scenario:
    """Read a scenario.

    Raises:
        InputError: every fault in the file by line and key.
    """
    return load_document(path, Scenario)


def builtin_scenarios() -> list[Path]:
    """The files that come with the package, sorted."""
    return sorted(FOLDER.glob("*.yaml"))
