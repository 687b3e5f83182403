"""How large an effect is: the amount at which it changes the torque of a motion by the size that is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from second_world.laws import LAWS, OUTSIDE, WorldLaw
from second_world.machine import DrawnMachine, largest_change
from second_world.motions import Motions
from second_world.world import DrawnWorld

#: A size is met when it is reached within this ratio.
TOLERANCE = 0.06
_TRIES = 7
#: Size of a path that is not the planned one [rad] over the one that is asked for.
_PATH = 0.2


def known_law(effect: Mapping[str, Any]) -> WorldLaw:
    """The law of an effect; the first one of its effect where none is named.

    Raises:
        ValueError: there is none.
    """
    laws = {**LAWS, **OUTSIDE}.get(effect["effect"], {})
    name = effect.get("law", next(iter(laws), None))
    if name not in laws:
        raise ValueError(f"second world: no law {name!r} for the effect {effect['effect']!r}")
    return laws[name]


def build(world: DrawnWorld, effects: Sequence[Mapping[str, Any]], day: int) -> DrawnMachine:
    """The machine of a world on a day, with effects whose amounts are known."""
    machine = DrawnMachine(world)
    machine.drift(day)
    for effect in effects:
        first = world.arm.joint_names.index(effect["joints"][0]) if effect["joints"] else 0
        rng = np.random.default_rng(np.random.SeedSequence([effect["seed"], 2]))
        known_law(effect).build(machine, first, effect["parameters"]["amount"], rng)
    return machine


def sized(world: DrawnWorld, effect: Mapping[str, Any], day: int, motions: Motions) -> dict[str, Any]:
    """The effect with its amount in `parameters`, and the size `found` with it along the motions, alone on the machine.

    The size is the largest rms change of torque over nominal, over motions and joints; that of a path, the largest rms
    change of set-points [rad]. It is not reached where the highest amount of the law does not do so.
    """
    law = known_law(effect)
    plain = None if effect["effect"] == "interpolator_mismatch" else build(world, (), day).run(motions)

    @cache
    def size(amount: float) -> float:
        machine = build(world, [{**effect, "parameters": {"amount": amount}}], day)
        if plain is None:
            return _path_change(machine, motions) / _PATH
        return largest_change(machine.run(motions), plain, world.arm.torque)

    if "amount" in effect["parameters"]:
        return {**effect, "found": size(effect["parameters"]["amount"])}
    asked = float(effect["size"])
    amount = _solved(lambda tried: np.log(max(size(tried), 1e-6) / asked), law.first, law.highest)
    return {**effect, "parameters": {"amount": amount}, "found": size(amount)}


def _solved(error: Callable[[float], float], first: float, highest: float) -> float:
    """The amount at which an error, of logarithms and rising, is least; by secants over the logarithm of the amount."""
    tried: list[tuple[float, float]] = []
    at, top = np.log(first), np.log(highest)
    for _ in range(_TRIES):
        tried.append((at, error(float(np.exp(at)))))
        below = [(-e, a) for a, e in tried if e < 0]
        above = [(e, a) for a, e in tried if e >= 0]
        if abs(tried[-1][1]) < TOLERANCE or (at == top and tried[-1][1] < 0):
            break
        if below and above:
            (down, low), (up, high) = min(below), min(above)
            at = low + (high - low) * min(max(down / (down + up), 0.1), 0.9)
        else:
            at = min(at - min(max(tried[-1][1], -2.5), 2.5), top)
    return float(np.exp(min((abs(e), a) for a, e in tried)[1]))


def _path_change(machine: DrawnMachine, motions: Motions) -> float:
    """[rad]."""
    largest = 0.0
    for points, _ in motions.values():
        executed = machine.executed(points)
        largest = max(largest, float(np.sqrt(np.mean((executed - points) ** 2, axis=0)).max()))
    return largest
