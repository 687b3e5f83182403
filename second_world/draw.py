"""Which runs there are: drawn from a seed over machines, joints, effects, laws and sizes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from second_world.laws import LAWS, OUTSIDE, WorldLaw
from second_world.world import LAWS as SETS, DrawnWorld, draw_world, machine_number

Card = TypeVar("Card")

#: Share of each kind of run in a draw; the rest has one effect.
SHARES = {"none": 1 / 3, "two": 0.12, "three": 0.05, "outside": 0.13}
#: Lowest and highest size: largest rms change of torque over nominal.
SIZES = (0.003, 0.05)
#: Size of an effect of strength 1.
USUAL_SIZE = 0.015

_GEARS = ("joint_elasticity", "backlash", "lopsided_backlash")
_COUNTS = {"none": 0, "two": 2, "three": 3}


def draw_cases(count: int, seed: int, laws: str) -> list[dict[str, Any]]:
    """`count` runs as plain data in random order, each with a machine of its own, which `world` describes.

    Effects and their laws come up equally often. An effect is {"effect", "law", "joints", "size", "seed",
    "parameters"}; `size` is what is asked for, and `parameters` hold the amount where it is known before the motion is.

    Raises:
        ValueError: `laws` is neither "development" nor "judgement".
    """
    if laws not in SETS:
        raise ValueError(f"laws: {laws!r} is not known; one of {', '.join(SETS)}")
    rng = np.random.default_rng(np.random.SeedSequence([SETS.index(laws), seed, 0]))
    kinds = [kind for kind, share in SHARES.items() for _ in range(round(share * count))]
    kinds = [str(kind) for kind in rng.permutation([*kinds, *["one"] * (count - len(kinds))])]
    inside, beyond = _LawDeck(LAWS, laws, rng), _LawDeck(OUTSIDE, laws, rng)
    cases = []
    for number, kind in enumerate(kinds):
        machine = machine_number(seed, number, laws)
        world = draw_world(machine)
        deck = beyond if kind == "outside" else inside
        size = float(np.exp(rng.uniform(*np.log(SIZES))))
        effects: list[dict[str, Any]] = []
        while len(effects) < _COUNTS.get(kind, 1):
            effect = _place(deck.draw(), world, size, rng)
            if not _collide(effect, effects, world):
                effects.append(effect)
        motion = 2 * int(rng.integers(2**61)) + SETS.index(laws)
        case = {"number": number, "kind": kind, "machine": machine, "motion": motion, "strength": size / USUAL_SIZE}
        cases.append({**case, "effects": effects, "recorder": world.recorder, "world": world.to_dict()})
    return cases


class _LawDeck:
    """Effects in random order, each once before any comes again; the same of the laws of each."""

    def __init__(self, effects: Mapping[str, Mapping[str, WorldLaw]], laws: str, rng: np.random.Generator):
        self._rng = rng
        self._laws = {}
        for name, known in effects.items():
            allowed = [law for law in known.values() if not law.reserved or laws == "judgement"]
            if allowed:
                self._laws[name] = self._shuffled(allowed)
        self._names = self._shuffled(list(self._laws))

    def _shuffled(self, cards: Sequence[Card]) -> Iterator[Card]:
        while True:
            yield from (cards[i] for i in self._rng.permutation(len(cards)))

    def draw(self) -> WorldLaw:
        return next(self._laws[next(self._names)])


def _place(law: WorldLaw, world: DrawnWorld, size: float, rng: np.random.Generator) -> dict[str, Any]:
    n = world.arm.n
    first = 1 if law.where == "lifting" else 0
    joints = {"arm": [], "wrist": [n - 2, n - 1]}.get(law.where, [int(rng.integers(first, n))])
    parameters = {}
    if law.effect == "torque_offset":
        parameters["amount"] = float(rng.choice([-1, 1])) * size * float(world.arm.torque[joints[0]])
    return {
        "effect": law.effect,
        "law": law.name,
        "joints": [world.arm.joint_names[joint] for joint in joints],
        "size": size,
        "seed": int(rng.integers(2**40)),
        "parameters": parameters,
    }


def _collide(effect: Mapping[str, Any], others: Sequence[Mapping[str, Any]], world: DrawnWorld) -> bool:
    """The same effect twice, two gears in one joint, or a path that nobody could see."""
    if effect["effect"] == "interpolator_mismatch" and not world.tracking:
        return True
    names = [other["effect"] for other in others]
    gears = [other["joints"] for other in others if other["effect"] in _GEARS]
    return effect["effect"] in names or (effect["effect"] in _GEARS and effect["joints"] in gears)
