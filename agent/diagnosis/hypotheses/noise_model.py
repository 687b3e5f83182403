"""Noise model: differences between model and machine without any fault.

"Nothing" is never literally true of an arm. A model errs a little everywhere, an arm changes from day to day, and
every arm has a little of some effects. Hypotheses are compared on top of these columns, so an effect counts only for
what they cannot take up (Kennedy and O'Hagan, J. R. Statist. Soc. B 63, 2001). How much of which effect an arm has
while it is healthy is learned from its own baseline (`healthy`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from agent.diagnosis.hypotheses.law import EvidenceLaw
from agent.diagnosis.rows.candidate import Candidate
from agent.diagnosis.rows.fit import Fit
from agent.diagnosis.rows.joined import joined, log_of_rows

ROW_SPACING = 0.016  # numerical: s between the rows that are kept: their rate is twice the usual cut-off of 30 Hz
_FORM = 100.0  # numerical: of σ² per noise column for a wrong form, at most: moments are of float32 columns
_NOTICED = 0.01  # numerical: energy over σ² of a direction of the noise model that is kept
_DRIFT = 3.0  # numerical: s between the nodes of a drift in time
_TURNING = 0.03  # of the highest speed, over which friction turns around
#: Nodes of the smooth functions of a joint's position (each way, and by direction), speed (likewise), acceleration and
#: time (at least).
_NODES = {"position": 8, "position_turned": 5, "speed": 4, "speed_turned": 5, "acceleration": 5, "time": 3}


@dataclass(frozen=True, eq=False)
class HealthyForm:
    """An effect that the arm has already, on the logs that are judged.

    `amount` (k,): standard deviation of each of its parameters from log to log. `mean`, `deviation` (k,): what the
    baseline had, and by how much a further log differs from it; None where the baseline does not show it.
    """

    candidate: Candidate
    amount: np.ndarray
    mean: np.ndarray | None = None
    deviation: np.ndarray | None = None


#: What is known of an arm.
Healthy = Sequence[HealthyForm]


class NoiseModel:
    """The noise model on the rows of some logs, next to the model's own columns and the residual.

    Every joint has [X, U, r], divided by its noise level σ: columns of the model's parameters, those of the noise model
    and the residual. Of U, `common` columns are shared by all logs; each log has the others for itself, turned so that
    they are orthogonal there.

    Parameters
    ----------
    fit : Fit
        Residual and columns of the model on the logs.
    candidates : sequence of Candidate
        Their effects that every arm has a little of count as usual unless several logs of this arm were compared.
    healthy : sequence of HealthyForm, optional
        Effects that the healthy arm has. None if nothing is known.
    law : EvidenceLaw
        The numbers of the decision.
    """

    def __init__(self, fit: Fit, candidates: Sequence[Candidate], healthy: Healthy | None, law: EvidenceLaw):
        self.law, self.dof = law, len(fit.rows)
        signals = fit.signals
        kept_time = joined(signals, "time")
        rate = 1 / float(np.median(np.diff(signals[0].time[signals[0].kept])))
        self._whitening, self._step = fit.whitening, max(1, round(ROW_SPACING * rate))
        thin = slice(None, None, self._step)
        self.sigma, self.nominal = fit.sigma[thin], fit.reference.scale
        self.rows = len(self.sigma)
        base = self.sigma.min(axis=0)
        self.nominal_over_sigma = self.nominal / base
        self.weight = self._step / rate / law.error_correlation_time
        self.count = self.rows * self.weight
        q, qd, qdd = (joined(signals, name)[thin] for name in ("q", "qd", "qdd"))
        self.log = log = log_of_rows(signals)[thin]
        self._logs = [slice(a, b) for a, b in pairwise(np.flatnonzero(np.diff(log, prepend=-1, append=-1)).tolist())]
        # what the only log of a baseline shows has no scatter, and its motion shows little of other effects
        unknown = healthy is None or (healthy and all(effect.mean is None for effect in healthy))
        usual = self._usual(candidates) if unknown else {}
        healthy = healthy or ()
        # these logs say nothing of how much the model errs in other motion, however little noise they have
        noise_share = fit.reference.model.noise_share
        own_error = np.ones(self.dof) if noise_share is None else noise_share
        self._least_scale = own_error if fit.has_own_error and healthy else np.zeros(self.dof)
        spread = _spread(fit.precision) if fit.has_own_error else np.empty((len(fit.precision), 0))
        self.torque_share: list[float] = []
        self.columns: list[np.ndarray] = []
        self.moments: list[np.ndarray] = []
        self._widths: list[tuple[int, int, int]] = []
        for j, rows in enumerate(fit.rows):
            model_rows = fit.whitening.whitened(j, rows)[thin]
            smooth = smooth_columns(q[:, j], qd[:, j], qdd[:, j], kept_time[thin], log)
            shared = np.hstack([smooth * (base[j] / self.sigma[:, j])[:, None], *usual.get(j, ())])
            amounts = [self.thinned(h.candidate, j) * h.amount for h in healthy if j in h.candidate.blocks]
            self.torque_share.append(_torque_share(amounts))
            amounts = [self.torque_share[j] * columns for columns in amounts]
            log_columns = np.hstack([*amounts, model_rows[:, :-1] @ spread[fit.parameter_index[j]]])
            of_log = self._turned(self._noticed(log_columns))
            columns = np.hstack([model_rows[:, :-1], shared, of_log, model_rows[:, -1:]])
            self._widths.append((model_rows.shape[1] - 1, shared.shape[1], of_log.shape[1]))
            self.columns.append(columns.astype(np.float32))
            self.moments.append(self._squared(j, columns) * self.weight)

    def column_counts(self, joint: int) -> tuple[int, int]:
        """How many columns X and U have on a joint."""
        model, shared, of_log = self._widths[joint]
        return model, shared + of_log * len(self._logs)

    def thinned(self, candidate: Candidate, joint: int) -> np.ndarray:
        """(S, k) columns of a candidate on a joint, over σ, whitened at rests, of the rows that are kept."""
        white = self._whitening.whitened(joint, candidate.blocks[joint])
        return np.asarray(white[:: self._step], dtype=np.float32)

    def products_with_columns(self, joint: int, columns: np.ndarray) -> np.ndarray:
        """Products of [X, U, r] with columns (S, K) of a joint; in U, what differs from log to log comes log by log."""
        whole, (model, shared, of_log) = self.columns[joint], self._widths[joint]
        span = slice(model + shared, model + shared + of_log)
        by_log = [whole[rows, span].T @ columns[rows] for rows in self._logs]
        return np.vstack([whole[:, : span.start].T @ columns, *by_log, whole[:, span.stop :].T @ columns])

    def shared_count(self, joint: int) -> int:
        """How many columns of U all logs share."""
        return self._widths[joint][1]

    def variance(self, joint: int, scale: float, form_energy: float, uncatalogued_sizes: Mapping[int, float]) -> float:
        """Prior variance of the coefficients that are common to all logs, over σ²."""
        law, unit = self.law, float(self.nominal_over_sigma[joint])
        return (
            max(scale, self._least_scale[joint]) * law.systematic**2
            + (law.drift * unit) ** 2
            + min(law.form_error**2 * form_energy, _FORM)
            + (uncatalogued_sizes.get(joint, 0.0) * unit) ** 2
        )

    def _usual(self, candidates: Sequence[Candidate]) -> dict[int, list[np.ndarray]]:
        """Per joint columns (S, m) over σ of effects that every arm has a little of, as large as its smallest σ."""
        usual: dict[int, list[np.ndarray]] = {}
        least = self.sigma.min(axis=0)
        for candidate in {c.key: c for c in reversed(candidates) if c.effect.usual}.values():
            for joint in candidate.blocks:
                block = self.thinned(candidate, joint)
                size = np.sqrt(np.mean((block * self.sigma[:, [joint]]) ** 2, axis=0))
                some = size > 1e-9 * least[joint]
                if some.any():
                    usual.setdefault(joint, []).append(block[:, some] * (least[joint] / size[some]))
        return usual

    def usual_torque(self, effect: HealthyForm) -> float:
        """Torque over nominal, root mean square, on the joint with most, of this effect of the healthy arm."""
        candidate, weight = effect.candidate, (self.sigma / self.nominal[None]) ** 2
        columns = {j: self.torque_share[j] * self.thinned(candidate, j) * effect.amount for j in candidate.blocks}
        power = [float(np.mean((block**2).sum(axis=1) * weight[:, j])) for j, block in columns.items()]
        return float(np.sqrt(max(power, default=0.0)))

    def _noticed(self, columns: np.ndarray) -> np.ndarray:
        """(S, b) columns with coefficients N(0, 1) that span the columns (S, k), which have such coefficients too.

        Directions that all logs together hardly notice are left out.
        """
        energy, directions = np.linalg.eigh(columns.T @ columns * self.weight)
        return np.asarray(columns @ directions[:, energy > _NOTICED])

    def _turned(self, columns: np.ndarray) -> np.ndarray:
        """(S, b) columns whose coefficients are N(0, 1) in each log, orthogonal in each."""
        parts = [columns[rows] for rows in self._logs]
        return np.concatenate([part @ np.linalg.eigh(part.T @ part)[1] for part in parts])

    def _squared(self, joint: int, columns: np.ndarray) -> np.ndarray:
        """Products of [X, U, r] with themselves."""
        model, shared, of_log = self._widths[joint]
        first = model + shared
        by_log, common = columns[:, first : first + of_log], np.delete(columns, np.s_[first : first + of_log], axis=1)
        cross = np.hstack([common[rows].T @ by_log[rows] for rows in self._logs])
        square = block_diag(*(by_log[rows].T @ by_log[rows] for rows in self._logs))
        whole = np.block([[common.T @ common, cross], [cross.T, square]])
        order = np.r_[0:first, first + 1 : len(whole), first]
        return np.asarray(whole[np.ix_(order, order)])


def _torque_share(parts: Sequence[np.ndarray]) -> float:
    """Part of their amounts that effects with columns (S, k) have: together as much torque as the largest one alone.

    Each was learned as if it explained by itself what the model of a healthy arm leaves, which is one torque.
    """
    energy = [float(np.sum(part**2)) for part in parts]
    return float(np.sqrt(max(energy, default=0.0) / max(sum(energy), 1e-300)))


def smooth_columns(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, time: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Return smooth functions of one joint's position, speed, acceleration, log and time.

    Parameters
    ----------
    q, qd, qdd : ndarray, shape (S,)
        Motion of the joint [rad, rad/s, rad/s²].
    time : ndarray, shape (S,)
        Seconds since the start of the row's log.
    log : ndarray of int, shape (S,)
        Number of the row's log.

    Returns
    -------
    ndarray, shape (S, m)
        Columns of order one.
    """
    columns = np.hstack(list(smooth_parts(q, qd, qdd, time, log).values()))
    return np.asarray(columns[:, np.abs(columns).max(axis=0) > 1e-6])


def smooth_parts(
    q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, time: np.ndarray, log: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the same columns by what they are functions of."""
    speed = np.abs(qd)
    sign = np.tanh(qd / (_TURNING * max(float(speed.max()), 1e-9)))[:, None]
    logs = (log[:, None] == np.unique(log)).astype(float)
    drift = []
    for here in logs.T.astype(bool):
        low, high = float(time[here].min()), float(time[here].max())
        drift.append(_hats(time, max(_NODES["time"], int((high - low) / _DRIFT) + 1), low, high) * here[:, None])
    return {
        "position": np.hstack([_hats(q, _NODES["position"]), sign * _hats(q, _NODES["position_turned"])]),
        "speed": np.hstack([sign * _hats(speed, _NODES["speed_turned"], 0.0), _hats(speed, _NODES["speed"], 0.0)]),
        "acceleration": _hats(qdd, _NODES["acceleration"]),
        "time": np.hstack([logs, sign * logs, *drift]),
    }


def _hats(x: np.ndarray, count: int, low: float | None = None, high: float | None = None) -> np.ndarray:
    """(S, count) piecewise linear functions between equal nodes."""
    low = float(np.min(x)) if low is None else low
    high = float(np.max(x)) if high is None else high
    nodes = np.linspace(low, max(high, low + 1e-9), count)
    return np.asarray(np.maximum(0, 1 - np.abs(x[:, None] - nodes) / (nodes[1] - nodes[0])))


def _spread(precision: np.ndarray) -> np.ndarray:
    """(p, p) a square root of the covariance of parameters whose units differ widely."""
    unit = 1 / np.sqrt(np.diag(precision))
    inverse = solve_triangular(scaled_cholesky(precision, unit), np.eye(len(unit)), lower=True)
    return np.asarray(unit[:, None] * inverse.T)


def scaled_cholesky(matrix: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor of a positive definite matrix (m, m) whose rows and columns are multiplied by `unit`.

    Where noise explains nearly all of a column, round-off of the products may leave less than nothing. Twice what they
    are wrong by is then added to all.
    """
    scaled = matrix * np.outer(unit, unit) + 1e-12 * np.eye(len(unit))
    try:
        return np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        wrong = -2 * float(np.linalg.eigvalsh(scaled)[0])
        return np.linalg.cholesky(scaled + wrong * np.eye(len(unit)))
