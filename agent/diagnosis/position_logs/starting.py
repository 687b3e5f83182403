"""Where the fit of the servo numbers begins if it fails from the file's: where the recorded motion itself points.

A file may be wrong by orders of magnitude (position servos as stiff as a simulator allows, of a motor as soft as a
spring), so far that no derivative of its motion leads to the arm's. The equation of each joint,

    r(t − τ) − q = (M q̈ + g + Iₐ q̈) / kₚ + (d / kₚ) q̇ + (F / kₚ) sgn q̇,

is linear in 1 / kₚ, d / kₚ and F / kₚ, none below zero. Its derivatives of positions are rough, so it is a start alone.
Bodies of a file may also collide where the recorded arm passed: then its motion ends there, whatever the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import nnls

from agent.diagnosis.position_logs.fitting import LONGEST_DELAY, missed
from agent.diagnosis.position_logs.stretch import CommandedStretch
from agent.model import NominalModel
from agent.robot import Dynamics
from agent.simulators import FreeSimulator, ServoNumbers


def free_of_contacts(
    simulator: FreeSimulator, numbers: Sequence[ServoNumbers], stretches: Sequence[CommandedStretch]
) -> FreeSimulator:
    """The simulator without contacts of bodies that touch at recorded positions.

    The simulator itself is returned if with one of the `numbers` its motion is nearer to the positions. Where no other
    bodies touch at set-points, no contacts are looked for.
    """
    pairs, others = (
        simulator.colliding(np.concatenate(parts))
        for parts in zip(*((stretch.position, stretch.wanted.set_points) for stretch in stretches), strict=True)
    )
    touches = bool({*others} - {*pairs})
    if not pairs:
        return simulator if touches else simulator.without_contacts()
    free = simulator.excluding(pairs) if touches else simulator.without_contacts(pairs)
    return min((simulator, free), key=lambda arm: min(error_of(arm, each, stretches) for each in numbers))


def numbers_by_equation(
    reference: NominalModel, file: ServoNumbers, stretches: Sequence[CommandedStretch]
) -> ServoNumbers:
    """kp, damping, friction and the arm's delay by the joints' equations, averaged over rows; armature is the file's.

    A joint whose motion does not tell its kp keeps the file's numbers.
    """
    bodies, n = Dynamics(reference.robot), len(file.kp)
    columns = []
    for stretch in stretches:
        qd = np.gradient(stretch.position, stretch.time, axis=0)
        qdd = np.gradient(qd, stretch.time, axis=0)
        torque = bodies.inverse_dynamics(stretch.position, qd, qdd) + file.armature * qdd
        columns.append(stretch.averaged(np.stack([torque, qd, np.sign(qd)], axis=2)[stretch.judged]))
    terms = np.concatenate(columns)
    frame = float(np.median(np.concatenate([np.diff(stretch.time) for stretch in stretches])))
    best, numbers = np.inf, file
    for delay in np.arange(0.0, LONGEST_DELAY, frame / 2):
        asked = np.concatenate([_asked(stretch, np.full(n, delay)) for stretch in stretches])
        solved = [nnls(terms[:, k], asked[:, k]) for k in range(n)]
        error = float(np.sum(np.log([max(norm, np.finfo(float).tiny) for _, norm in solved])))
        if error < best:
            ratios = np.array([values for values, _ in solved])
            determined = ratios[:, 0] > 0
            kp = np.where(determined, 1 / np.where(determined, ratios[:, 0], 1.0), file.kp)
            damping, friction = (
                np.where(determined, ratios[:, k] * kp, of_file)
                for k, of_file in ((1, file.damping), (2, file.friction))
            )
            best = error
            numbers = replace(file, damping=damping, friction=friction, kp=kp, delay=np.full(n, delay))
    return numbers


def _asked(stretch: CommandedStretch, delay: np.ndarray) -> np.ndarray:
    """(R, n) how far the set-points, late by `delay` (n,), are from the positions, in the middle of each row."""
    edges = np.append(stretch.time, 2 * stretch.time[-1] - stretch.time[-2])
    edges -= 0.5 * np.diff(edges, append=2 * edges[-1] - edges[-2])
    return stretch.averaged((stretch.command.between(edges, delay) - stretch.position)[stretch.judged])


def error_of(simulator: FreeSimulator, numbers: ServoNumbers, stretches: Sequence[CommandedStretch]) -> float:
    """Σ of the logarithms of the joints' mean squared errors; infinite where the simulator blows up."""
    motions = [stretch.run(simulator, numbers) for stretch in stretches]
    pairs = zip(stretches, motions, strict=True)
    squares = [missed(stretch, motion) ** 2 for stretch, motion in pairs if motion is not None]
    return float(np.sum(np.log(np.mean(np.concatenate(squares), axis=0)))) if len(squares) == len(motions) else np.inf
