"""Candidates: an effect on some joints with its columns, and the folds of the rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from agent.model import Effect, FitContext, ModelEffect, MotionSignals, NominalModel

#: An effect's name, and joints from 0; none for one of the whole arm or base.
EffectKey = tuple[str, tuple[int, ...]]
#: Effect, joints and nonlinear parameters of a candidate that is asked for.
Wanted = tuple[Effect, tuple[int, ...], Mapping[str, float]]
_Motions = Sequence[tuple[MotionSignals, np.ndarray]]  # each with its noise level (S', n) [N·m]

_AT_ONCE = 16  # numerical: columns filtered together, so that they stay in the cache
MADE_AT_ONCE = 64  # numerical: candidates made together: their intermediate arrays take as much memory as they do


class Blocks(Mapping[int, np.ndarray]):
    """Columns by joint, which can be released: those of all candidates together take hundreds of megabytes.

    Hypotheses are compared by moments, so rows are needed again for few of them, and these are made again.
    """

    def __init__(self, made: dict[int, np.ndarray], make: Callable[[], Mapping[int, np.ndarray]]):
        self._joints, self._make = tuple(made), make
        self._made: Mapping[int, np.ndarray] | None = made

    def release(self) -> None:
        """Free the memory."""
        self._made = None

    def __getitem__(self, joint: int) -> np.ndarray:
        if joint not in self._joints:
            raise KeyError(joint)
        if self._made is None:
            self._made = self._make()
        return self._made[joint]

    def __contains__(self, joint: object) -> bool:
        return joint in self._joints

    def __iter__(self) -> Iterator[int]:
        return iter(self._joints)

    def __len__(self) -> int:
        return len(self._joints)


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect somewhere, with nonlinear parameters chosen.

    `blocks`: joint → (S', k) over σ, all motions in a row; `prior` (k, k): precision of its parameters, None without.
    `stable`: whether its torque can be computed with; that of an unstable simulation overflows.
    """

    effect: Effect
    joints: tuple[int, ...]
    settings: Mapping[str, float]
    names: tuple[str, ...]
    blocks: Mapping[int, np.ndarray]
    prior: np.ndarray | None
    reference: NominalModel
    stable: bool = True

    @property
    def key(self) -> EffectKey:
        """Effect and joints."""
        return self.effect.name, self.joints

    @property
    def transient(self) -> bool:
        """Whether it happens once, so that no other log tells of it and it is judged by segments."""
        return self.effect.is_transient(self.settings)

    def release(self) -> None:
        """Free the memory of its columns, if they can be made again."""
        if isinstance(self.blocks, Blocks):
            self.blocks.release()

    def of_rows(self, rows: slice) -> Candidate:
        """The same on some of the rows."""

        def part() -> dict[int, np.ndarray]:
            return {joint: block[rows] for joint, block in self.blocks.items()}

        return replace(self, blocks=Blocks(part(), part))

    def text(self, joint_names: Sequence[str]) -> str:
        """Name of the candidate in steps and ranges."""
        where = ", ".join(joint_names[j] for j in self.joints)
        return f"{self.effect.name} of {where}" if where else self.effect.name

    def part_of_model(self, values: np.ndarray, joint_names: Sequence[str]) -> ModelEffect:
        """The effect with linear parameters (k,), as a model has it."""
        parameters = {**self.settings, **dict(zip(self.names, map(float, values), strict=True))}
        return ModelEffect(self.effect.name, tuple(joint_names[j] for j in self.joints), parameters)


@dataclass(frozen=True, eq=False)
class Fold:
    """Cells held out and cells fitted on, (cells,) bool each."""

    name: str
    test: np.ndarray
    train: np.ndarray


def parameter_ends(base: int, candidates: Iterable[Candidate]) -> np.ndarray:
    """Where the parameters of each candidate begin and end, behind `base` others."""
    return base + np.cumsum([0, *(len(candidate.names) for candidate in candidates)])


def make_candidates(context: FitContext, wanted: Sequence[Wanted], rough: bool = False) -> list[Candidate]:
    """Candidates with their columns, filtered like the torque and divided by the noise level of `context`.

    `rough`: in single precision, which is enough to compare them, until they are released and made again.
    """
    motions = list(zip(context.signals, context.sigmas, strict=True))
    made = []
    few = any(signals.position_response is not None for signals in context.signals)  # means, each of a whole motion
    for (effect, joints, settings), blocks in zip(wanted, _all_columns(motions, wanted, rough), strict=True):
        prior = effect.prior_precision(context, joints, settings)
        # not the context: it remembers the candidate, and a circle is not freed with the last reference
        make_again = partial(_made_again, motions, (effect, joints, settings))
        columns, names = blocks if few else Blocks(blocks, make_again), effect.names(settings)
        stable = all(np.abs(block).max(initial=0.0) < 1e15 for block in blocks.values())
        made.append(Candidate(effect, joints, dict(settings), names, columns, prior, context.reference, stable))
    return made


def _made_again(motions: _Motions, wanted: Wanted) -> dict[int, np.ndarray]:
    return _all_columns(motions, [wanted])[0]


def _all_columns(motions: _Motions, wanted: Sequence[Wanted], rough: bool = False) -> list[dict[int, np.ndarray]]:
    """Per candidate joint → (S', k) over σ, all motions in a row."""
    kinds, signals = {effect for effect, *_ in wanted}, [signals for signals, _ in motions]
    for kind in kinds:
        kind.prepare(signals, [(joints, settings) for effect, joints, settings in wanted if effect is kind])
    starts = range(0, len(wanted), MADE_AT_ONCE)
    made = [made for first in starts for made in _columns(motions, wanted[first : first + MADE_AT_ONCE], rough)]
    for kind in kinds:
        kind.release(signals)
    return made


def _columns(motions: _Motions, wanted: Sequence[Wanted], rough: bool) -> list[dict[int, np.ndarray]]:
    parts: list[dict[int, list[np.ndarray]]] = [{} for _ in wanted]
    for signals, sigma in motions:
        precision = np.float32 if rough and signals.position_response is None else np.float64
        over = [column[:, None] for column in np.ascontiguousarray(sigma.T, dtype=precision)]
        if signals.position_response is not None:
            _add_in_positions(signals, over, wanted, parts)
            continue
        filtered_by_effect = [effect.filtered(signals, joints, settings) for effect, joints, settings in wanted]
        for some in _batches(
            signals, [(k, wanted[k]) for k, columns in enumerate(filtered_by_effect) if columns is None]
        ):
            block_rows = signals.low_pass(np.concatenate([block.T for *_, block in some], dtype=precision).T)
            ends = np.cumsum([block.shape[1] for *_, block in some])[:-1]
            for (number, joint, _), block in zip(some, np.split(block_rows, ends, axis=1), strict=True):
                parts[number].setdefault(joint, []).append(block / over[joint])
        for number, blocks in enumerate(filtered_by_effect):
            for joint, block in (blocks or {}).items():
                parts[number].setdefault(joint, []).append(np.divide(block, over[joint], dtype=precision))
    return [{joint: np.concatenate(block) for joint, block in by_joint.items()} for by_joint in parts]


def _add_in_positions(
    signals: MotionSignals,
    over: Sequence[np.ndarray],
    wanted: Sequence[Wanted],
    parts: Sequence[dict[int, list[np.ndarray]]],
) -> None:
    """Add what positions show of each candidate to its parts: a torque on one joint moves its neighbours too."""
    assert signals.position_response is not None
    torques = []
    for number, (effect, joints, settings) in enumerate(wanted):
        if (shown := effect.in_positions(signals, joints, settings)) is None:
            torques.append(number)
            continue
        for joint, block in shown.items():
            parts[number].setdefault(joint, []).append(block / over[joint])
    if not torques:
        return
    columns = [effect.columns(signals, joints, settings) for effect, joints, settings in (wanted[k] for k in torques)]
    widths = [next(iter(by_joint.values())).shape[1] for by_joint in columns]
    ends = np.cumsum([0, *widths])
    together: dict[int, np.ndarray] = {}
    for by_joint, first, last in zip(columns, ends[:-1], ends[1:], strict=True):
        for joint, block in by_joint.items():
            into = together.setdefault(joint, np.zeros((len(signals.time), int(ends[-1]))))
            into[:, first:last] = block
    for joint, moved in signals.position_response(together).items():
        for number, (first, last) in zip(torques, pairwise(ends.tolist()), strict=True):
            parts[number].setdefault(joint, []).append(moved[:, first:last] / over[joint])


def _batches(
    signals: MotionSignals, wanted: Sequence[tuple[int, Wanted]]
) -> Iterator[list[tuple[int, int, np.ndarray]]]:
    """Columns to be filtered, some at a time: number of the candidate, joint, (S, k)."""
    some: list[tuple[int, int, np.ndarray]] = []
    width = 0
    for number, (effect, joints, settings) in wanted:
        for joint, block in effect.columns(signals, joints, settings).items():
            some.append((number, joint, block))
            width += block.shape[1]
            if width >= _AT_ONCE:
                yield some
                some, width = [], 0
    if some:
        yield some
