"""Entry point for logs of positions and commands: the servos' numbers, then the same law of evidence as with torque.

1. The simulator runs under the recorded command; its servo numbers and the delay are fitted (`fitting`).
2. What that leaves, and how every number and effect would move the arm, are rows (`linear_rows`).
3. Numbers go back to the file's where that loses nothing, effects are searched, and a verdict is given, as with torque.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from agent.core import InputError
from agent.data_quality import unsigned_torque
from agent.diagnosis.hypotheses.law import LAW
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.position_logs.fitting import (
    EXTRA,
    LOAD_NUMBERS,
    FreeParameters,
    OutputErrorFit,
    OutputErrorProblem,
    fit_output_error,
    missed,
    usual_scale,
    widest_lag,
)
from agent.diagnosis.position_logs.linear_rows import assemble_positions
from agent.diagnosis.position_logs.starting import error_of, free_of_contacts, numbers_by_equation
from agent.diagnosis.position_logs.stretch import CommandedStretch, lost_frames, stretches_of
from agent.diagnosis.rows.needs import MotionCoverage
from agent.diagnosis.simulator_file.explanation import Explanation, explain_rows
from agent.model import MotionSignals, NominalModel
from agent.recording import HELD, HOLD, SMOOTH, Log
from agent.simulators import FreeSimulator, ServoNumbers, Simulator

_ROUGH = 0.05  # numerical: of the cost: a fit to start from gains less in its last round
_NARROWER, _CUTS = 0.9, 30  # numerical: of a cut of commands, the next one that is tried, and how many are
_HOLDS = "holds"  # friction, a stationary joint
_REVERSALS = 2  # derived: load and friction of a joint that turns back once are one step


@dataclass(frozen=True, eq=False)
class PositionExplanation:
    """An explanation of position logs, and its warnings."""

    explanation: Explanation
    warnings: tuple[str, ...]


def without_torque(simulator: Simulator, logs: Sequence[Log]) -> bool:
    """Whether a simulator is judged by positions: no log has torque, or all have a current without sign and a servo.

    Raises:
        InputError: torque in some logs only.
    """
    bare = [log for log in logs if log.effort is None]
    if (
        not bare
        and not isinstance(simulator.arm.servos, str)
        and all(log.reference_position is not None for log in logs)
    ):
        return bool(np.any(unsigned_torque(logs)))
    if bare and len(bare) < len(logs):
        other = next(log for log in logs if log.effort is not None)
        raise InputError(
            f"{bare[0].path}: no torque (effort) was recorded, and {other.name} has some: give logs that all have "
            "torque, or none of which has"
        )
    return bool(bare)


def search_positions(
    simulator: Simulator,
    logs: Sequence[Log],
    without: Sequence[str],
    progress: Callable[[str], None],
    known_kp: bool = False,
) -> PositionExplanation:
    """Judge a simulator's file by positions and commands; `known_kp`: the gains of its servos are right.

    Raises:
        InputError: a file without servos, or logs that cannot be used (see `stretches_of`).
    """
    if isinstance(simulator.arm.servos, str):
        raise InputError(
            f"{logs[0].path}: no torque (effort) was recorded, and {simulator.arm.path.name} has no position servo for "
            f"each joint that would follow set-points: {simulator.arm.servos}. Record the current times the torque "
            "constant of the joint, or give an MJCF with a position actuator (kp, kv, forcerange) on every joint, and "
            "logs with set-points; joints without one can be left out (--map)"
        )
    free, reference = FreeSimulator(simulator.arm), NominalModel(simulator.model)
    progress("running the simulator under the recorded command")
    fit, how, later = _fitted(free, reference, logs, progress, known_kp)
    dataset = assemble_positions(fit, simulator, logs, known_kp, later)
    turns = _reversal_warnings(dataset.fit.signals, simulator.arm.joint_names)
    warnings = (*_about(fit, how, later, simulator.arm.impedance), *turns)
    return PositionExplanation(explain_rows(dataset, without, progress), warnings)


def _fitted(
    free: FreeSimulator,
    reference: NominalModel,
    logs: Sequence[Log],
    progress: Callable[[str], None],
    known_kp: bool,
) -> tuple[OutputErrorFit, str, float]:
    """The fit, how the command is held if the motion has to tell, and how much later [s] the other way would be.

    The likelier way is taken, where the error of each joint is unknown, Π rmse^-N: a recorder holds what it sends, and
    smooth is what does better beyond chance. The delay of the other way is possible too: a drive that follows with a
    lag of its own smooths held commands, and an effect on a joint prefers either way.
    """
    recorded_holds = {log.metadata.get(HOLD, "") for log in logs} & {HELD, SMOOTH}
    ways = sorted(recorded_holds) if len(recorded_holds) == 1 else [HELD, SMOOTH]
    file = free.numbers
    # of a start that fades with e^(-t / T), what counts as nothing is left
    transient_time = -float(np.log(LIMITS.negligible)) * float(np.max(file.damping / np.maximum(file.kp, 1e-9)))
    settling = min(transient_time, min(log.t[-1] - log.t[0] for log in logs) / LIMITS.log_parts)
    stretches = stretches_of(logs, ways[0] == HELD, settling)
    by_equation = numbers_by_equation(reference, file, stretches)
    free = free_of_contacts(free, (file, by_equation), stretches)
    fixed = ("kp", *EXTRA) if known_kp else EXTRA
    parameters = FreeParameters.create(usual_scale(reference, file, stretches).vector, fixed)
    bare = _bare(OutputErrorProblem(free, reference, stretches, parameters), by_equation, progress)
    best = _with_cut_commands(bare, _settled(_simplest(bare, progress, known_kp), progress), progress, known_kp)
    return (best, "", 0.0) if len(ways) == 1 else _hold_of_commands(best, logs, settling, progress)


def _bare(problem: OutputErrorProblem, by_equation: ServoNumbers, progress: Callable[[str], None]) -> OutputErrorFit:
    """The fit from the file's numbers on, or from those of the joints' equations where these are nearer."""
    arm, rough = problem.simulator, FreeParameters.create(problem.parameters.scale, fixed=("kp", *EXTRA))
    start = fit_output_error(replace(problem, parameters=rough), arm.numbers, progress, _ROUGH).numbers
    start = min((start, by_equation), key=lambda numbers: error_of(arm, numbers, problem.stretches))
    return fit_output_error(problem, start, progress)


def _with_cut_commands(
    bare: OutputErrorFit, uncut: OutputErrorFit, progress: Callable[[str], None], known_kp: bool
) -> OutputErrorFit:
    """The fit with commands that a recorder cut, where that explains more than a load and the like of `uncut` do."""
    for numbers in (replace(bare.simulator.numbers, delay=bare.numbers.delay), bare.numbers):
        if (nearest := _nearest(bare, numbers)) == np.inf:
            continue
        problem = replace(bare.problem, stretches=tuple(stretch.cut(nearest) for stretch in bare.stretches))
        refitted = fit_output_error(problem, numbers, progress)
        if _gains(bare, refitted).sum() <= _by_chance(1):
            continue
        start = replace(uncut, stretches=problem.stretches)
        if uncut.load.any():  # a load imitates a cut
            start = _simplest(refitted, progress, known_kp)
        cut = _settled(start, progress)
        believed = cut.stretches[0].nearest >= _nearest_cut(bare.stretches)
        if believed and _gains(uncut, cut).sum() > _by_chance(1):
            return cut
    return uncut


def _hold_of_commands(
    held: OutputErrorFit, logs: Sequence[Log], settling: float, progress: Callable[[str], None]
) -> tuple[OutputErrorFit, str, float]:
    """The fit with commands `held` from frame to frame or smooth between them, as `_fitted` has it."""
    # a held command is late by half a frame in the middle
    start = replace(held.numbers, delay=held.numbers.delay + 0.5 * _frame(held.stretches))
    stretches = tuple(stretch.cut(held.stretches[0].nearest) for stretch in stretches_of(logs, False, settling))
    smooth = _again(replace(held, stretches=stretches, numbers=start), progress)
    chosen, how, other = (smooth, SMOOTH, held) if _gains(held, smooth).sum() > _by_chance(1) else (held, HELD, smooth)
    return chosen, how, float(np.mean(other.numbers.delay - chosen.numbers.delay))


def _settled(fit: OutputErrorFit, progress: Callable[[str], None]) -> OutputErrorFit:
    """The fit in which one joint that keeps a large error does not decide the numbers of the others."""
    return _again(_again(fit, progress), progress)  # the first changes what joints leave, and so their weights


def _again(fit: OutputErrorFit, progress: Callable[[str], None]) -> OutputErrorFit:
    """The fit from its own numbers on, joints weighed by the errors that it left."""
    return fit_output_error(fit.problem, fit.numbers, progress, load=fit.load, errors=fit.rmse)


def _simplest(fit: OutputErrorFit, progress: Callable[[str], None], known_kp: bool) -> OutputErrorFit:
    """The fit that what follows is linear about: one with gains, or with a load at the last link and gains as they are.

    Gains, friction and rotors of all joints together imitate a load, and it them. So each is tried by itself. The other
    one, an offset of each servo, a spring at each joint, a delay of each joint in place of the arm's, and friction that
    holds a stationary joint where the file's is soft follow one by one where they do better than chance, what does best
    first: soft friction imitates an offset, and the other way round.
    """
    file = fit.simulator.numbers
    n = len(file.kp)
    scales = (usual_scale(fit.reference, numbers, fit.stretches).vector for numbers in (file, fit.numbers))
    scale = np.maximum(*scales)
    count = {"kp": n, "load": len(LOAD_NUMBERS), _HOLDS: 1} | dict.fromkeys(EXTRA, n)
    count |= {"delay": n - 1} if n > 1 else {}

    def fitted(start: OutputErrorFit, numbers: ServoNumbers, free: Sequence[str], **how: float) -> OutputErrorFit:
        fixed = [kind for kind in ("kp", *EXTRA) if kind not in free]
        parameters = FreeParameters.create(scale, fixed, "delay" not in free, "load" in free)
        of_start = replace(start.problem, parameters=parameters)
        return fit_output_error(of_start, numbers, progress, load=start.load, **how)

    loaded = fitted(fit, replace(file, delay=fit.numbers.delay), ["load"], gained=_ROUGH)
    if np.mean(np.log(loaded.rmse / fit.rmse)) < np.log(LIMITS.usual_error):
        loaded = fitted(loaded, loaded.numbers, ["load"])
    carries = bool(_gains(fit, loaded).sum() > (_by_chance(len(LOAD_NUMBERS)) if known_kp else 0.0))
    best, free = (loaded, ["load"]) if carries else (fit, [] if known_kp else ["kp"])
    further = [kind for kind in count if kind not in free and not (known_kp and kind == "kp")]
    while further:
        starts = {kind: best for kind in further} | {_HOLDS: replace(best, simulator=best.simulator.holding())}
        tried = {kind: fitted(starts[kind], best.numbers, [*free, kind], gained=_ROUGH) for kind in further}
        beyond = {kind: float(_gains(best, other).sum()) - _by_chance(count[kind]) for kind, other in tried.items()}
        if "delay" in tried and np.ptp(tried["delay"].numbers.delay) <= fit.simulator.step:
            beyond["delay"] = -np.inf  # a simulation in such steps does not tell
        kind = max(beyond, key=lambda each: beyond[each])
        if beyond[kind] <= 0:
            break
        free = [*free, kind]
        best = fitted(tried[kind], tried[kind].numbers, free)
        further.remove(kind)
    return best


def _nearest(fit: OutputErrorFit, numbers: ServoNumbers) -> float:
    """About how near [rad or m] to the positions commands were cut; infinite where no cut does better.

    A recorder with such a limit (LeRobot's max_relative_target) stores what was wanted, not what was sent. The
    `numbers` are the file's, or fitted: without a cut, fitted ones follow one that is too wide.
    """

    def error(nearest: float) -> float:
        cut = [stretch.cut(nearest) for stretch in fit.stretches]
        motions = [stretch.run(fit.simulator, numbers) for stretch in cut]
        pairs = zip(cut, motions, strict=True)
        return sum(np.inf if m is None else float(np.sum((missed(s, m) / fit.sigma) ** 2)) for s, m in pairs)

    narrower = widest_lag(fit.stretches) * _NARROWER ** np.arange(1, _CUTS)
    best, least = np.inf, error(np.inf)
    for nearest in narrower[narrower >= _nearest_cut(fit.stretches)].tolist():
        here = error(nearest)
        if here > LIMITS.equal_ratio**2 * least:  # the error falls towards a cut, and rises beyond it
            break
        best, least = (nearest, here) if here < least else (best, least)
    return best


def _nearest_cut(stretches: Sequence[CommandedStretch]) -> float:
    """The nearest cut [rad or m] that is believed: cut commands hold the measured positions, which any stiff servo
    follows, so that most commands of each joint have to be as they were wanted."""
    lag = np.concatenate([np.abs(stretch.wanted.set_points - stretch.position) for stretch in stretches])
    return float(np.quantile(lag, LIMITS.majority, axis=0).max())


def _gains(fit: OutputErrorFit, other: OutputErrorFit) -> np.ndarray:
    """(n,) log-likelihood that another fit gains on each joint, where the joint's error is unknown."""
    duration = sum(float(stretch.time[-1] - stretch.time[0]) for stretch in fit.stretches)
    return np.asarray(duration / LIMITS.row_correlation_time * (np.log(fit.rmse) - np.log(other.rmse)))


def _by_chance(count: int) -> float:
    """Log-likelihood that `count` numbers which change nothing gain at most, by half a χ² (Wilks)."""
    return float(chdtri(count, 1 - LAW.confidence)) / 2


def _frame(stretches: Sequence[CommandedStretch]) -> float:
    return float(np.median(np.concatenate([np.diff(stretch.time) for stretch in stretches])))


def _about(fit: OutputErrorFit, how: str, later: float, impedance: np.ndarray) -> list[str]:
    name = fit.simulator.arm.path.name
    warnings = [
        f"no torque was measured: {name} runs under the recorded command, and its motion is compared with the measured "
        "one. kv and damping of a joint are one number there"
    ]
    if how:
        words = {HELD: "held from frame to frame", SMOOTH: "smooth between frames"}
        other, change = words[SMOOTH if how == HELD else HELD], "more" if later > 0 else "less"
        warnings.append(
            f"neither logs nor motion tell how the command was held: it is taken as {words[how]}; if it was {other}, "
            f"the delay is {1e3 * abs(later):.3g} ms {change}"
        )
    if (nearest := fit.stretches[0].nearest) < np.inf:
        warnings.append(
            f"commands were cut to within {nearest:.3g} rad or m of the positions on their way, as a recorder with "
            "max_relative_target does, or servos whose torque ends there; the logs have what was wanted"
        )
    if pairs := fit.simulator.arm.excluded:
        warnings.append(
            f"bodies of {name} reach into each other where the arm was recorded ({_listed(pairs)}): it is simulated "
            "without these contacts (exclude in a corrected file)"
        )
    if np.any(fit.simulator.arm.impedance > impedance):
        warnings.append(
            f"friction of {name} is soft, as MuJoCo's is by default: it lets a stationary joint creep. The arm's "
            "holds, and is simulated so (solimpfriction of a corrected file)"
        )
    if lost := lost_frames(fit.stretches, fit.residuals):
        warnings.append(
            f"the lag behind the command jumps by about a frame at {lost} places: frames were lost there, or stamps "
            "are made from frame numbers; record real stamps"
        )
    return warnings


def _listed(pairs: Sequence[tuple[str, str]]) -> str:
    return ", ".join(" and ".join(pair) for pair in pairs)


def _reversal_warnings(signals: Sequence[MotionSignals], names: Sequence[str]) -> list[str]:
    reversals = MotionCoverage.of(signals).reversals
    steady = ", ".join(name for name, count in zip(names, reversals, strict=True) if count < _REVERSALS)
    warning = f"{steady} turn back less than {_REVERSALS} times, so that their friction and gain cannot be told"
    return [warning] if steady else []
