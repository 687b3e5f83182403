"""What follows a motion along its plan, and motions that it follows, without a link."""

from collections.abc import Sequence

import numpy as np

from agent.motion.interpolator import Trajectory
from agent.robot import load_robot
from agent.safety.adherence import Adherence
from drivers.protocol import SampleBlock
from tests.conftest import drawn

PERIOD = 0.002
#: Any posture does.
HOME = np.radians(
    drawn(
        [0.0, 0.0, -90.0, 0.0, 0.0, 0.0],
        lambda rng: rng.uniform([-60, -20, -110, -60, -60, -60], [60, 20, -70, 60, 60, 60]).tolist(),
    )
)
ROBOT = load_robot("comau_ns16")


class Clock:
    """Our time [s], by hand."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def at(plan: Trajectory, times: np.ndarray) -> np.ndarray:
    """(K, n) of a plan; it holds its last position."""
    return np.column_stack([np.interp(times, plan.t, column) for column in plan.q.T])


def paced(chain: Trajectory, scale: float) -> np.ndarray:
    """(K, n) of a chain that takes `scale` times as long as planned."""
    return at(chain, np.arange(0.0, scale * chain.t[-1] + PERIOD, PERIOD) / scale)


def watcher(*chains: Trajectory, margin: float = 0.02) -> Adherence:
    """What follows these chains."""
    return Adherence(chains, ROBOT, None, margin, PERIOD)


def follow(
    check: Adherence,
    *pieces: np.ndarray,
    chunk: int = 10,
    lag: int = 0,
    servo: float | np.ndarray = 0.0,
    given: bool = True,
    first: int = 0,
) -> tuple[str, float] | None:
    """Reason and time [s] at which a check says stop; None where it never does. Pieces are (K, n) set-points.

    What is measured comes `lag` samples late and is off by `servo` [rad]; the set-points come along where `given`.
    """
    everything = np.concatenate(pieces)
    measured = np.concatenate([np.repeat(everything[:1], lag, axis=0), everything])[: len(everything)] + servo
    return run(check, measured, everything if given else None, chunk, first)


def run(
    check: Adherence,
    measured: np.ndarray,
    given: np.ndarray | None,
    chunk: int = 10,
    first: int = 0,
    began: float = 0.0,
    period: float = PERIOD,
) -> tuple[str, float] | None:
    """The same for what is measured and given (K, n); the first sample is stamped `began` [s]."""
    zeros = np.zeros_like(measured)
    for start in range(first, len(measured), chunk):
        part = slice(start, start + chunk)
        sequence = np.arange(len(measured))[part]
        times = began + period * sequence
        seen: Sequence | None = None if given is None else given[part]
        block = SampleBlock(sequence, times, measured[part], None, zeros[part], seen, None)
        reason = check.take(block)
        if reason is not None:
            return reason, float(block.time[-1])
    return None
