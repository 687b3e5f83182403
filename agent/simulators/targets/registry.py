"""The numbers of a calibrated arm where each simulator wants them.

To add a simulator: a module with a function from `ArmNumbers` and the step of its physics to texts by file name, its
line in `TARGETS`, and what it can say of every effect in `effects.json`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from agent.core import InputError, write_atomically
from agent.model import CATALOGUE, FileNumbers
from agent.runs import make_folder
from agent.simulators.targets import genesis, isaaclab, mjcf, mjlab, newton, usd
from agent.simulators.targets.arm_numbers import ArmNumbers


class Target(NamedTuple):
    """A simulator: its name for people, its files, and the usual step of its physics [s].

    `computes_servo`: whether its servo is an explicit torque, so that the step limits its gains. `has_passive`: whether
    its files have effects that passive forces say.
    """

    name: str
    files: Callable[[ArmNumbers, float], Mapping[str, str]]
    step: float
    computes_servo: bool
    has_passive: bool = False
    has_offset: bool = False


#: Steps: MuJoCo's default timestep; sim.dt that Isaac Lab's arm tasks have (1/120 s); that of mjlab's tasks; 1/1000 s
#: of newton:timeStepsPerSecond; Genesis' SimOptions.dt. A file's own timestep replaces them.
TARGETS = {
    "mjcf": Target("MuJoCo", mjcf.files, 0.002, computes_servo=False, has_passive=True, has_offset=True),
    "isaaclab": Target("Isaac Lab", isaaclab.files, 1 / 120, computes_servo=True),
    "mjlab": Target("mjlab", mjlab.files, 0.005, computes_servo=False),
    "usd": Target("USD (PhysX, Newton, MuJoCo)", usd.files, 1 / 120, computes_servo=False),
    "newton": Target("Newton", newton.files, 0.001, computes_servo=True),
    "genesis": Target("Genesis", genesis.files, 0.01, computes_servo=False),
}
_LEFT_OUT = "left_out.json"
_OFFSET = next(effect.name for effect in CATALOGUE.values() if effect.numbers == FileNumbers.OFFSET)
_NEARLY = "in the files, but not exactly"


def target_of(name: str) -> Target:
    """The simulator of that name, in any case.

    Raises:
        InputError: there is none.
    """
    if name.lower() not in TARGETS:
        raise InputError(f"--for {name}: no such simulator; there are {', '.join(TARGETS)}")
    return TARGETS[name.lower()]


def write_target(numbers: ArmNumbers, name: str, folder: Path, say: Callable[[str], None]) -> tuple[Path, ...]:
    """Write the files of a simulator into a folder; returns their paths. `say` is told what they lack, and traps.

    Args:
        numbers: of the arm.
        name: of the simulator, a key of `TARGETS`.
        folder: for the files.
        say: told what the files lack, and traps of this simulator.

    Raises:
        InputError: no such simulator.
        AgentError: the folder cannot be written.
    """
    target = target_of(name)
    missing, step = list(_left_out(numbers, name.lower(), target)), numbers.step or target.step
    texts = dict(target.files(numbers, step))
    texts[_LEFT_OUT] = json.dumps({"schema": "left-out/1", "simulator": target.name, "effects": missing}, indent=1)
    make_folder(folder, "the export")
    paths = tuple(
        write_atomically(folder / file, text + ("" if text.endswith("\n") else "\n")) for file, text in texts.items()
    )
    for effect in missing:
        could = "cannot say it" if effect["how"] == "no" else f"could say it {effect['how']}, which is not written"
        where = _NEARLY if effect["how"] == _NEARLY else f"not in the files ({target.name} {could})"
        say(f"{effect['effect']}{effect['of']} is {where}: {effect['leaves']}")
    for text in (*numbers.notes, *(_unstable(numbers, step) if target.computes_servo else ())):
        say(text)
    return paths


def _left_out(numbers: ArmNumbers, name: str, target: Target) -> Iterator[dict[str, str]]:
    """Effects that the files do not have, how the simulator could have them, and what of the gap that leaves."""
    has_passive = target.has_passive
    known = json.loads(Path(__file__).with_name("effects.json").read_text(encoding="utf-8"))
    for joint in numbers.joints if not target.has_offset else ():
        if joint.offset:
            unit = "mm" if joint.prismatic else "mrad"
            leaves = (
                f"add {1e3 * joint.offset:+.4g} {unit} to its set-points ({joint.closes or 'the servo stands there'})"
            )
            yield {
                "effect": _OFFSET,
                "of": f" of {joint.name}",
                "how": known[_OFFSET].get(name, "no"),
                "leaves": leaves,
            }
    for entry in numbers.left:
        how, leaves = known.get(entry.effect, {}).get(name, "no"), entry.leaves
        if has_passive and entry.forces is not None:
            how, leaves = _NEARLY, f"{100 * entry.misses:.0f} % of its torque stays out"
        of = f" of {', '.join(entry.joints)}" if entry.joints else ""
        if not has_passive or entry.forces is None or round(100 * entry.misses):
            yield {"effect": entry.effect, "of": of, "how": how, "leaves": leaves}


def _unstable(numbers: ArmNumbers, step: float) -> Iterator[str]:
    """Gains that an explicit servo cannot have at this step: dt √(kp / I) < 2 and kd dt / I < 1, with the least I."""
    for joint in numbers.joints:
        if joint.kp is None or joint.kv is None:
            continue
        stiffest, most = 4 * joint.inertia / step**2, joint.inertia / step
        if joint.kp >= stiffest or joint.kv >= most:
            yield (
                f"{joint.name}: at a physics step of {1e3 * step:.3g} ms an explicit servo is stable below kp "
                f"{stiffest:.3g} and kv {most:.3g}, and it has {joint.kp:.3g} and {joint.kv:.3g}: take a shorter step, "
                "or an implicit actuator without delay"
            )
