"""From an estimate to a model: uncertainty, conditioning, and what a user should know about the fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from agent.estimation.normal_equations import Moments, observed_standstill_speed
from agent.estimation.partition import SELDOM_SHARE, SLIDING_SHARE
from agent.estimation.prior import DESCRIPTION
from agent.estimation.problem import Estimate, Problem
from agent.estimation.selection import paper_terms
from agent.estimation.signals.observation import ENOUGH_TIME, Observation
from agent.estimation.uncertainty import covariance, parameter_prior, unobserved_directions
from agent.model import BAD_CONDITION, RESTS, IdentifiedModel, Reversal, condition_text
from agent.recording import Log, machines_of

_NOTABLE_STANDSTILL = 0.05
_TOO_FAST = 2.0  # times a joint's highest speed by the robot description
_NAMED = 8  # parameters of directions that are not in the data


def build_model(problem: Problem, fit: Estimate, method: str, logs: Sequence[Log]) -> IdentifiedModel:
    """The identified model of an estimate."""
    observation, moments = problem.observation, problem.moments
    rows = moments.rows.sum(axis=(0, 1))
    times = problem.autocorrelation_times(fit.parameters)
    first = observation.segments[0].motion
    silent = unobserved_directions(moments, fit.weights, problem.prior, times)
    model = IdentifiedModel(
        robot=observation.robot,
        independent=observation.rigid.independent,
        projection=observation.rigid.projection,
        standard_names=observation.rigid.standard_names,
        combinations=observation.rigid.combinations,
        terms=problem.terms,
        values=fit.parameters,
        covariance=covariance(problem, fit),
        cutoff=first.cutoff,
        order=first.order,
        method=method,
        weights=fit.weights,
        residual_rmse=np.sqrt(moments.energy(fit.parameters).sum(axis=0) / rows),
        held_out_rmse=np.sqrt(fit.held_out.sum(axis=(0, 1)) / rows),
        condition_number=condition_number(moments.weighted(fit.weights)),
        standard=fit.standard,
        group_rmse=_group_rmse(moments, fit),
        standstill_speed=observed_standstill_speed(observation),
        prior=parameter_prior(problem, fit),
        provenance={
            **_provenance(observation, logs),
            "link_prior": problem.links,
            "range": fitted_range(observation),
            "open_directions": len(silent),
            "short": observation.seconds < ENOUGH_TIME * sum(float(log.t[-1] - log.t[0]) for log in logs),
            "doubts": list(_doubts(problem.observation)),
        },
    )
    model = replace(model, values=np.where(model.unmoved, problem.prior.mean, model.values))
    return replace(model, notes=tuple(_notes(model, problem, fit, silent)))


def _group_rmse(moments: Moments, fit: Estimate) -> np.ndarray:
    """(2, n) held-out RMSE in motion, and at standstill: not below that in motion, which does where none stands."""
    rows = moments.rows.sum(axis=0)
    moving, still = np.sqrt(fit.held_out.sum(axis=0) / np.maximum(rows, 1))
    moving = np.where(rows[0] > 0, moving, still)
    return np.stack([moving, np.maximum(moving, still)])


def condition_number(total: np.ndarray) -> float:
    """Of the weighted observation matrix with its columns scaled to unit length, from its moments; inf beyond 1e7."""
    length = np.sqrt(np.diag(total)[:-1])
    if np.any(length <= 1e-12 * length.max()):
        return float("inf")
    values = np.linalg.eigvalsh(total[:-1, :-1] / np.outer(length, length))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 1e-14 * values[-1] else float("inf")


def _notes(model: IdentifiedModel, problem: Problem, fit: Estimate, silent: np.ndarray) -> Iterator[str]:
    segments = "segments of the motion, all cycles together, with a guard between them"
    kind = "whole motions" if problem.partition.whole_motions else segments
    yield f"Held-out errors: {problem.partition.folds} folds of {kind}."
    if fit.note:
        yield fit.note
    if fit.prior_weight > 0:
        yield from _described_links(model, problem)
        if problem.terms == paper_terms([Reversal()] * model.robot.dof, ("offset",)):
            yield (
                "Friction: Coulomb, viscous and an offset per axle; further terms, and sliding that reverses more "
                "smoothly, do not lower the held-out error."
            )
    yield from model.provenance["doubts"]
    if problem.observation.noisy is not None:
        yield (
            f"Record positions with more digits to use faster motion: above the cut-off of {model.cutoff:g} Hz their "
            f"noise outweighs the torque, most on {model.robot.joint_names[problem.observation.noisy]}."
        )
    if model.condition_number > BAD_CONDITION:
        number = condition_text(model.condition_number)
        yield (
            f"The condition number of the observation matrix is {number}: these motions hardly separate some "
            "parameters. Predictions of similar motions are sound, single values are not; a motion planned for "
            "excitation, or a larger sub-region, separates them."
        )
    if len(silent) and fit.prior_weight > 0:
        names = ", ".join(_leading_names(model.names, silent))
        yield (
            f"Record more varied motion if you need these values: {names}. These logs leave {len(silent)} of "
            f"{len(model.values)} combinations of parameters open, and the prior fills them "
            f"({_prior_in_words(problem.links)}). Torque of similar motions does not depend on them."
        )
    still = problem.moments.rows[:, 1].sum(axis=0) / problem.moments.rows.sum(axis=(0, 1))
    lighter = np.sqrt(fit.weights[1] / fit.weights[0])
    shares = [
        f"{name} {100 * share:.0f} % (weight {weight:.2f})"
        for name, share, weight in zip(model.robot.joint_names, still, lighter, strict=True)
        if share > _NOTABLE_STANDSTILL
    ]
    if shares:
        yield (
            "Standstill, where friction is anything within stiction, is in the fit with the weight its residuals "
            f"earn: {', '.join(shares)}."
        )


def _described_links(model: IdentifiedModel, problem: Problem) -> Iterator[str]:
    """What the data say of the links that the description has, where they were not believed as usual."""
    rigid = problem.observation.rigid
    described = rigid.projection @ np.append(rigid.dynamics.standard_parameters(), np.zeros(model.robot.dof))
    if not np.any(described):
        yield "The description has no link masses: nothing is assumed of the links but what their torques could hold."
        return
    if problem.links == DESCRIPTION:
        return
    q = np.concatenate([s.motion.q[:: max(len(s.motion.q) // 200, 1)] for s in problem.observation.segments])
    still = np.zeros_like(q)
    ours, theirs = (
        np.sqrt(np.mean(rigid.torque(q, still, still, base) ** 2, axis=0)) for base in (model.base_values, described)
    )
    rows = [
        f"{joint.name} {a:.3g} and {b:.3g} {'N' if joint.prismatic else 'N·m'}"
        for joint, a, b in zip(model.robot.joints, ours, theirs, strict=True)
        if a > 0
    ]
    weight = (
        f" Gravity torque, root mean square over these postures, by this fit and by the description: {', '.join(rows)}."
    )
    yield (
        "The link inertials of the description are left out of the prior: they predict segments held out no better and "
        f"do not make these torques likelier.{weight if rows else ''}"
    )


def _doubts(observation: Observation) -> Iterator[str]:
    """What in the motion itself speaks for a channel that is dead or of another unit."""
    robot = observation.robot
    motions = (segment.motion for segment in observation.segments)
    extremes = np.array([(m.q.min(axis=0), m.q.max(axis=0), np.abs(m.qd).max(axis=0)) for m in motions])
    travelled = extremes[:, 1].max(axis=0) - extremes[:, 0].min(axis=0)
    resting = np.flatnonzero(travelled <= RESTS * robot.max_velocity)
    if len(resting):
        names = ", ".join(robot.joint_names[k] for k in resting)
        yield (
            f"These joints never move: {names}. Their friction and inertia are not in the data; if they did move, "
            "their positions were not recorded."
        )
    qd = np.concatenate([segment.motion.qd[segment.motion.kept] for segment in observation.segments])
    least = SLIDING_SHARE * np.abs(qd).max(axis=0)
    forth, back = np.sum(qd > least, axis=0), np.sum(qd < -least, axis=0)
    one_way = np.minimum(forth, back) < SELDOM_SHARE * (forth + back)
    for k in np.flatnonzero(one_way & (travelled > RESTS * robot.max_velocity)):
        yield (
            f"{robot.joint_names[k]} goes one way only: its friction and an offset of its torque are the same there; "
            "run it both ways"
        )
    times = extremes[:, 2].max(axis=0) / robot.max_velocity
    for k in np.flatnonzero(times > _TOO_FAST):
        speed = f"{extremes[:, 2, k].max():.3g} {'m' if robot.joints[k].prismatic else 'rad'}/s"
        yield (
            f"{robot.joint_names[k]} reaches {speed}, {times[k]:.3g} times its highest speed by the robot description: "
            "are the unit of its positions and its gear ratio right?"
        )


def _prior_in_words(links: str) -> str:
    return "links near the URDF" if links == DESCRIPTION else "links no heavier than their torques could hold"


def _leading_names(names: Sequence[str], directions: np.ndarray) -> list[str]:
    """The parameters that have most of these directions (d, p), largest first."""
    share = np.sum(directions**2, axis=0)
    return [names[k] for k in np.argsort(-share)[:_NAMED] if share[k] > 0.1]


def _provenance(observation: Observation, logs: Sequence[Log]) -> dict[str, Any]:
    rows = [sum(len(s.time) for s in observation.segments if s.log_index == k) for k in range(len(logs))]
    return {
        **{key: machine for key, machine in machines_of(logs).items() if machine},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "smoothing_hz": float(observation.segments[0].motion.pass_edge),
        "logs": [
            {
                "log": log.name,
                "sha256": log.sha256,
                "samples": len(log.t),
                "rate_hz": float(log.sample_rate),
                "duration_s": float(log.t[-1] - log.t[0]),
                "rows_per_joint": count,
                "repairs": [str(repair) for repair in log.repairs],
            }
            for log, count in zip(logs, rows, strict=True)
        ],
    }


_FASTER = 1.15  # times the highest speed of the fit: its friction there is a guess
_SLOW = 0.02  # of a joint's highest speed at all: up to that no motion is fast
_FURTHER = 0.25  # of the angles of the fit, beyond them: gravity is known there, what depends on the angle is not
_LEAST = 0.1  # rad or m; less further hardly matters
_OFTEN = 0.01  # of the samples


def fitted_range(observation: Observation) -> dict[str, Any]:
    """Of all rows of the fit and each joint: its lowest and highest position and its highest speed (SI), for a model's
    provenance."""
    motions = [segment.motion for segment in observation.segments]
    q = np.concatenate([motion.q[motion.kept] for motion in motions])
    qd = np.concatenate([motion.qd[motion.kept] for motion in motions])
    return {
        "lowest": q.min(axis=0).tolist(),
        "highest": q.max(axis=0).tolist(),
        "fastest": np.abs(qd).max(axis=0).tolist(),
    }


def known_positions(model: IdentifiedModel) -> tuple[np.ndarray, np.ndarray] | None:
    """(n,) lowest and highest positions [rad, m] that are still those of a model's fit; None where it does not say."""
    known = model.provenance.get("range")
    if known is None:
        return None
    lowest, highest = (np.array(known[key]) for key in ("lowest", "highest"))
    far = np.maximum(_FURTHER * (highest - lowest), _LEAST)
    return lowest - far, highest + far


def beyond_fit(model: IdentifiedModel, motions: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterator[str]:
    """What to know of motions, each positions and speeds (S, n) (SI), that leave the range of a model's fit for more
    than a moment; nothing where the model does not say what its fit was."""
    known = model.provenance.get("range")
    if known is None:
        return
    lowest, highest, fastest = (np.array(known[key]) for key in ("lowest", "highest", "fastest"))
    q, speed = np.concatenate([q for q, _ in motions]), np.abs(np.concatenate([qd for _, qd in motions]))
    units = [joint.position_unit for joint in model.robot.joints]

    def of_joints(beyond: np.ndarray, text: Callable[[int], str]) -> str:
        often = np.flatnonzero(np.mean(beyond, axis=0) > _OFTEN).tolist()
        return "; ".join(f"{model.robot.joint_names[k]} {text(k)}" for k in often)

    faster = speed > np.maximum(_FASTER * fastest, _SLOW * model.robot.max_velocity)
    if joints_text := of_joints(
        faster, lambda k: f"at up to {speed[:, k].max():.3g} {units[k]}/s, fitted up to {fastest[k]:.3g}"
    ):
        yield (
            f"these logs go faster than the motions that the model was fitted to ({joints_text}): friction there is "
            "extrapolated, treat results there with care"
        )
    lower, upper = known_positions(model) or (lowest, highest)
    if joints_text := of_joints(
        (q < lower) | (q > upper),
        lambda k: (
            f"between {q[:, k].min():.3g} and {q[:, k].max():.3g} {units[k]}, fitted between {lowest[k]:.3g} and "
            f"{highest[k]:.3g}"
        ),
    ):
        yield f"these logs go where the model was never fitted ({joints_text}): treat results there with care"
