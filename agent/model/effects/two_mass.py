"""Rotor and link with a gear that gives way between them, driven by the rigid load."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers

_MASSLESS = 1e-9  # kg·m² or kg: a description of kinematics alone, whose links cannot ring
FREQUENCIES = np.geomspace(3.0, 36.0, 34)  # Hz of a link on its locked motor
DAMPING = (0.04, 0.12)  # numerical: ratios of a link that rings, from which a search starts
_RATE = 1500.0  # numerical: Hz of the integration, at least
_TRIED = 2  # numerical: of a joint's grid, in full
_SUSPECT = 1.3  # numerical: Σ e² / noise² a row, from where a joint gets the whole grid, and half of the worst's
_PROMISING = 0.15  # numerical: of a joint's Σ e² / σ², from where on neighbours of the best are worth a look
_NEIGHBOURS = (1.12, 1.05)  # numerical: factors of frequency and play, finer with every round


def leads(
    motions: Sequence[MotionSignals], joints: np.ndarray, stiffness: np.ndarray, gap: np.ndarray, damping: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per motion ṗ + s d [N·m], d̈ [rad/s²] and d [rad], d the motor's lead over the link, (S, K) float32 for K of each
    argument (K,).

    The motor moves as measured, so the link's momentum p = m ḋ obeys ṗ + c ḋ + k z(d) = L − s d, with L the torque the
    rigid link would take, s(t) how it changes with the joint's position (the link hangs where it is, not where its
    motor is), m(t) its inertia about the joint, z(d) the twist beyond half the play (without play z(d) = d) and
    c = 2 ζ √(k m̄), which acts while the teeth touch. Semi-implicit steps, all motions and all K at once; a link that
    is lighter in some posture than the steps can follow (k h² / m > 1) counts as one that they can.

    How the links ring when a log begins is not known, so they are damped more at first: a start is forgotten with the
    fourth power of the time gone, and not carried on by a little damping.
    """
    from agent.compiled import driven_through_play

    longest = max(len(motion.time) for motion in motions)

    def side_by_side(parts: list[np.ndarray]) -> np.ndarray:
        padded = [np.pad(part, ((0, longest - len(part)), (0, 0)), mode="edge") for part in parts]
        return np.ascontiguousarray(np.hstack(padded))

    load = side_by_side([motion.link_load for motion in motions])
    diagonal = [np.diagonal(motion.mass, axis1=1, axis2=2) for motion in motions]
    inertia = np.maximum(side_by_side(diagonal), 1e-9)
    slope = side_by_side([np.diagonal(motion.link_slope, axis1=1, axis2=2) for motion in motions])
    dof = motions[0].q.shape[1]
    column = np.concatenate([motion * dof + joints for motion in range(len(motions))])
    k, half = np.tile(stiffness, len(motions)), 0.5 * np.tile(gap, len(motions))
    c = 2 * np.tile(damping, len(motions)) * np.sqrt(k * inertia.mean(axis=0)[column])
    period = float(np.median(np.diff(motions[0].time)))
    substeps = max(2, int(np.ceil(_RATE * period)))
    step = period / substeps
    first = load[0, column]
    twist = first / k + np.sign(first) * half
    followed = 1 / np.maximum(step**2 * k, step * c)
    moving = step * load, step * slope, 1 / inertia
    parts = driven_through_play(*moving, column, followed, step * k, step * c, half, twist, step, substeps, period)
    torque, second, twisted = (np.split(part, len(motions)) for part in parts)
    return [
        (momentum_rate.T[: len(motion.time)], acceleration.T[: len(motion.time)], lead.T[: len(motion.time)])
        for momentum_rate, acceleration, lead, motion in zip(torque, second, twisted, motions, strict=True)
    ]


class TwoMass(Effect):
    """τ_k = −a (d/dt(M_kk ḋ) + s_kk d), τ_j = −a (M_jk d̈ + s_jk d), a near 1: what joints feel of a motor that leads
    its link by d; s_jk = ∂τ_j / ∂q_k of the links.

    A resonance is far narrower than a step of any grid that could be tried in full. So the whole `grid` is tried on the
    joint itself, where it costs one column each, then the neighbours of the best, and only the best of all on all
    joints. A joint that the model predicts gets a few of the grid, to say what would be found there.
    """

    linear = ("share",)
    units = MappingProxyType({"stiffness": "N·m/rad"})
    leading = ("stiffness",)
    stepped = "arm_two_mass"
    fast_torque = True
    nonlinear = ("stiffness",)

    #: (frequency [Hz] of the link on its locked motor, damping ratio, play [rad])
    grid: ClassVar[tuple[tuple[float, float, float], ...]]
    few: ClassVar[tuple[tuple[float, float, float], ...]]

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        (k,) = joints
        if _inertia(context, k) <= _MASSLESS:
            return []
        return self._refined(context, k, *self._on_single_joint(context)[k], self._on_joint)

    def _refined(
        self,
        context: FitContext,
        k: int,
        tried: Sequence[dict[str, float]],
        columns: np.ndarray,
        on_joint: Callable[[FitContext, int, Sequence[Mapping[str, float]]], np.ndarray],
    ) -> list[dict[str, float]]:
        """The best of what was tried, with columns (S', K) on the joint alone, and of its neighbours."""
        best, gain = self._best(context, k, tried, columns)
        energy, noise = _energy(context)[k], _noise_share(context)[k]
        for factor in _NEIGHBOURS:
            if gain < _PROMISING * energy * len(columns) or (context.keeps_parameters and energy <= noise):
                break
            neighbours = [neighbour for entry in best for neighbour in self._neighbours(entry, factor)]
            best, gain = self._best(context, k, neighbours, on_joint(context, k, neighbours))
        return best

    def _best(
        self, context: FitContext, k: int, tried: Sequence[dict[str, float]], columns: np.ndarray
    ) -> tuple[list[dict[str, float]], float]:
        """The ones that gain most, possible ones first, and the first one's gain."""
        gain, share = context.energy_taken(k, columns)
        possible = np.array([self.plausible({}, {"share": value}) for value in share])
        order = np.lexsort((-gain, ~possible))[:_TRIED]
        return [tried[index] for index in order], float(gain[order[0]])

    def _neighbours(self, entry: dict[str, float], factor: float) -> list[dict[str, float]]:
        """Every combination of nonlinear parameters a step up, as they are, and a step down."""
        steps = {"stiffness": factor**2, "damping": factor**4, "gap": factor}
        moved = [name for name in entry if name in steps]
        values = [[entry[name] * steps[name] ** power for power in (-1, 0, 1)] for name in moved]
        return [{**entry, **dict(zip(moved, combination, strict=True))} for combination in product(*values)]

    def _on_single_joint(self, context: FitContext) -> dict[int, tuple[list[dict[str, float]], np.ndarray]]:
        """Per joint: the grid, and (S', len(grid)) torque on this joint alone, motions concatenated."""
        by_effect = context.signals[0].memory.setdefault("alone", {})
        if self.name not in by_effect:
            heavy = (k for k in range(context.reference.robot.dof) if _inertia(context, k) > _MASSLESS)
            by_effect[self.name] = {}
            for k in heavy:
                entries = self._starting_grid(context, k)
                by_effect[self.name][k] = entries, self._on_joint(context, k, entries)
        return by_effect[self.name]

    def _starting_grid(self, context: FitContext, k: int) -> list[dict[str, float]]:
        inertia = _inertia(context, k)
        energy = _energy(context) / _noise_share(context)
        suspect = max(min(_SUSPECT, 0.5 * energy.max()), 1.0 if context.keeps_parameters else 0.0)
        grid = self.grid if energy[k] > suspect else self.few
        return [
            {"stiffness": inertia * (2 * np.pi * frequency) ** 2, "damping": damping, **({"gap": gap} if gap else {})}
            for frequency, damping, gap in grid
        ]

    def _on_joint(self, context: FitContext, k: int, tried: Sequence[Mapping[str, float]]) -> np.ndarray:
        self.prepare(context.signals, [((k,), entry) for entry in tried])
        parts = []
        for signals in context.signals:
            parts.append(signals.shown(k, -np.stack([self._lead(signals, k, entry)[0] for entry in tried]).T))
        self.release(context.signals)  # large, and few of them are needed again
        return np.concatenate(parts)

    def prepare(self, motions: Sequence[MotionSignals], wanted: Sequence[tuple[Joints, Numbers]]) -> None:
        keys = dict.fromkeys(_key(joints[0], settings) for joints, settings in wanted)
        leads_of_motions = [motion.memory.setdefault("leads", {}) for motion in motions]
        new = [key for key in keys if any(key not in of_motion for of_motion in leads_of_motions)]
        if not new:
            return
        joints, stiffness, damping, gap = (np.array(part) for part in zip(*new, strict=True))
        for of_motion, parts in zip(leads_of_motions, leads(motions, joints, stiffness, gap, damping), strict=True):
            of_motion.update(zip(new, zip(*(part.T for part in parts), strict=True), strict=True))

    def release(self, motions: Sequence[MotionSignals]) -> None:
        for motion in motions:
            motion.memory.pop("leads", None)

    def _lead(self, signals: MotionSignals, k: int, settings: Numbers) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return signals.memory["leads"][_key(k, settings)]

    def reported(self, reference: NominalModel, settings: Numbers, values: Numbers) -> dict[str, float]:
        return _behind_the_gear({**settings, **values})

    def stepped_parameters(self, values: Numbers, inertia: Sequence[float]) -> dict[str, Any] | None:
        """With the damper of a link of its mean inertia."""
        whole = _behind_the_gear(values)
        return {**whole, "damper": 2 * whole["damping"] * math.sqrt(whole["stiffness"] * inertia[0])}

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        (k,) = joints
        self.prepare([signals], [(joints, settings)])
        torque, second, lead = self._lead(signals, k, settings)
        felt = signals.mass[:, :, k] * second[:, None] + signals.link_slope[:, :, k] * lead[:, None]
        felt[:, k] = torque
        return {j: -felt[:, j, None] for j in range(signals.q.shape[1])}


def _behind_the_gear(values: Numbers) -> dict[str, float]:
    """The parameters of a gear behind which is all of the link: a share of the torque is a twist larger by as much.

    An arm of which more than its links is behind a gear falls.
    """
    share = values["share"]
    twist = {"gap": share * values["gap"]} if "gap" in values else {}
    return {**values, "stiffness": values["stiffness"] / share, **twist, "share": 1.0}


def _inertia(context: FitContext, k: int) -> float:
    """Mean inertia that a joint carries [kg·m², or kg]."""
    return float(np.mean([s.mass[:, k, k].mean() for s in context.signals]))


def _energy(context: FitContext) -> np.ndarray:
    """(n,) mean of (e / σ)² of what is left."""
    parts = zip(context.residuals, context.sigmas, strict=True)
    return np.mean(np.concatenate([(residual / sigma) ** 2 for residual, sigma in parts]), axis=0)


def _noise_share(context: FitContext) -> np.ndarray:
    """(n,) part of σ² that differs from row to row, as far as known: no smooth error of a model rings."""
    share = context.reference.model.noise_share
    return np.ones(context.reference.robot.dof) if share is None else share


def _key(k: int, settings: Numbers) -> tuple[int, float, float, float]:
    return k, settings["stiffness"], settings["damping"], settings.get("gap", 0.0)
