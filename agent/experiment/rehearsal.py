"""A rehearsal of a motion: what the diagnosis would say after it, each of the rivals taken for true in turn.

The logs stay as they are. On the motion the torque is drawn: that of the rival and of the model's change, as the logs
leave them, and the model's error on top. Parameters are drawn by the wild bootstrap (see `agent.diagnosis.evidence`):
the error that a rival leaves gets new signs for every segment of a second, so what lasts makes them as uncertain as it
should. What the logs hardly show of a form is about as large as the cause, on the logs and the motion together. The
error on the motion is put together from segments of that on the logs; it is larger or smaller there, joint by joint, by
as much as it was found to be from one motion to the next. Then the search and the verdict are the diagnosis' own, with
the places that are open and their simpler forms. The shares of right answers are what a motion is expected to tell.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from agent.diagnosis import (
    Candidate,
    Dataset,
    Diagnosis,
    Finding,
    Fit,
    HeldOutScore,
    Search,
    complexity,
    drawn_change,
    folds_of,
    judge,
    plausible,
    without_places,
)
from agent.experiment.motion import GridMotion, background_on
from agent.experiment.questions import OpenPair, Place, as_usual
from agent.model import CATALOGUE, MotionSignals, NominalModel
from agent.recording import PARTS, PLANNED_PARTS
from agent.robot import Tool

#: Rows are thinned to this rate [Hz]: what is asked about moves slower.
_RATE = 60.0
#: Standard deviation of ln RMS of the model's error from one motion to another, over all joints: measured on the
#: further motions of eleven runs of the active check, on joints without an effect.
_SCATTER = 0.3
#: A form is as large as the cause, give or take so many times it.
_RESTRAINT = 3.0
#: Of its forms that explain the logs as well as the best those of so many numbers of parameters may be true, the fewest
#: first, and so many of the simplest; parameters that cannot be true are drawn again, so often.
_TRUE, _ALIKE, _TRIES = 2, 3, 20


@dataclass(frozen=True)
class Said:
    """A verdict, and the class of every cause in it: its place and those that equal it, the first cause first."""

    verdict: str
    classes: tuple[tuple[Place, ...], ...]

    def settles(self, place: Place) -> bool:
        """Whether a place is the first cause, and nothing equals it."""
        return self.verdict == "explained" and self.classes[0] == (place,)

    def names(self, place: Place, rival: Place) -> bool:
        """Whether a place is a cause or equals one, and its rival is neither: of the two it is the answer."""
        members = {other for one in self.classes for other in one}
        return place in members and rival not in members


def said_by(finding: Finding) -> Said:
    """What a search came to."""
    classes = zip(finding.causes, finding.rivals, strict=True)
    return Said(finding.verdict, tuple((cause.place, *rivals) for cause, rivals in classes))


class Rehearsal:
    """Motions run one after the other (`pieces`) in one log, with a known `load` at the flange or none, after the logs
    of a diagnosis with open pairs of rivals."""

    def __init__(
        self,
        found: Diagnosis,
        pairs: Sequence[OpenPair],
        pieces: Sequence[GridMotion],
        load: Tool | None = None,
        progress: Callable[[str], None] = lambda text: None,
    ):
        self._progress = progress
        self._found, self._pairs = found, [pair for pair in pairs if pair.second.forms]
        self._dataset = _with_motion(found.dataset, pieces, load)
        self._new = self._dataset.log == len(found.dataset.logs)
        fit = self._dataset.fit
        self._of_logs = ~np.isin(np.arange(fit.cells), fit.cell[self._new])
        names = found.dataset.robot.joint_names
        open_places = {side.place(names) for pair in self._pairs for side in (pair.first, pair.second)}
        self._only = {*open_places, *(c.place for c in found.finding.causes)}
        for effect, joints in list(self._only):
            simpler = [name for name in CATALOGUE[effect].special_cases if CATALOGUE[name].scope == "joint"]
            self._only |= {(name, (joint,)) for name in simpler for joint in joints}

    def said(self, draws: int, seed: int = 0, most: int | None = None) -> dict[Place, list[Said]]:
        """What is said in so many draws where each of the open hypotheses is true, or of the `most` urgent ones."""
        names = self._dataset.robot.joint_names
        beside = {side.place(names): pair.fit.chosen for pair in self._pairs for side in (pair.second, pair.first)}
        found: dict[Place, list[Said]] = {}
        for k, (place, chosen) in enumerate(list(beside.items())[:most]):
            found[place] = []
            for left in self._drawn(place, chosen, draws, np.random.default_rng([seed, k])):
                self._progress(f"the motion is rehearsed with {place[0]} taken for true")
                found[place].append(self._answer(left))
        return found

    def _answer(self, left: np.ndarray) -> Said:
        fit = self._dataset.fit.with_residual(left)
        dataset = replace(self._dataset, fit=fit, residual=left * fit.sigma)
        search = Search(fit, given=dataset.given, limits=dataset.limits, only=self._only)
        finding, _ = judge(dataset, search.run(), fit)
        if ruled_out := self._found.finding.ruled_out:
            finding, _ = judge(dataset, without_places(dataset, replace(finding, ruled_out=ruled_out)), fit)
        return said_by(finding)

    def _drawn(
        self, place: Place, others: Sequence[Candidate], draws: int, rng: np.random.Generator
    ) -> Iterator[np.ndarray]:
        """(S', n) over the background: residuals as measured on the logs, and as drawn on the motion."""
        fit = self._dataset.fit
        beside = fit.candidates([(c.effect, c.joints, c.settings) for c in others])
        truths = [fit.with_chosen([*beside, form]) for form in self._forms(place, fit.with_chosen(beside))]
        measured = np.stack([rows[:, -1] for rows in fit.rows], axis=1)
        for number in range(draws if truths else 0):
            left = measured.copy()
            left[self._new] = self._torque(truths[number % len(truths)], rng)
            yield left

    def _forms(self, place: Place, fit: Fit) -> list[Candidate]:
        """Of those that explain the logs as well as the best the simplest, the likeliest first, and the likeliest that
        is less simple, each kept to about the size of the gap; or what the effect is as a rule.

        Of several as simple, a warm-up over seconds or minutes, which these logs tell no better apart, any may be true.
        """
        effect, train = CATALOGUE[place[0]], self._of_logs
        inverse, alone = fit.solve(train)
        made: list[tuple[float, Candidate, np.ndarray]] = []
        for one in fit.candidates([(effect, place[1], settings) for settings in effect.settings(fit, place[1])]):
            form = self._restrained(one)
            ((_, (cross, own)),) = fit.moments([form])
            b, a = cross[train].sum(axis=0) / fit.repeat, own[train].sum(axis=0) / fit.repeat
            side = b[-1] - b[:-1].T @ alone
            values = np.linalg.solve(
                a + fit.ridge(form, own.sum(axis=0).diagonal()) - b[:-1].T @ inverse @ b[:-1], side
            )
            if plausible(HeldOutScore(form, 0.0, 0.0, values)):
                made.append((float(side @ values) * fit.repeat, form, values))
        least = max((gain for gain, *_ in made), default=0.0) - self._found.finding.least
        good = sorted((entry for entry in made if entry[0] >= least), key=lambda entry: -entry[0])
        levels = sorted({complexity(form) for _, form, _ in good})[:_TRUE]
        simplest, *richer = ([entry for entry in good if complexity(entry[1]) == level] for level in levels or [0])
        usual = as_usual(fit, *simplest[0][1:]) if simplest else None
        if usual is not None:
            return [usual]
        apart = np.unique(np.linspace(0, len(simplest) - 1, _ALIKE).astype(int)) if simplest else ()
        return [form for _, form, _ in (*(simplest[k] for k in apart), *(level[0] for level in richer))]

    def _restrained(self, form: Candidate) -> Candidate:
        """A form with a prior that keeps each of its parameters to about the torque that is to be explained."""
        joints = self._found.finding.causes[0].blocks if self._found.finding.causes else form.blocks
        size = sum(float(np.mean(self._dataset.fit.rows[joint][~self._new, -1] ** 2)) for joint in joints)
        square = sum((np.mean(block**2, axis=0) for block in form.blocks.values()), np.zeros(len(form.names)))
        kept = np.diag(square / (_RESTRAINT**2 * max(size, 1e-9)))
        return replace(form, prior=kept if form.prior is None else form.prior + kept)

    def _torque(self, true: Fit, rng: np.random.Generator) -> np.ndarray:
        """(S', n) over the background, on the motion, of what is true and of the model's change and error."""
        mean = true.solve(self._of_logs)[1]
        error = true.remaining(mean) / true.sigma
        error[self._new] = 0.0
        torque = np.zeros((int(self._new.sum()), error.shape[1]))
        for _ in range(_TRIES):
            parameters = mean + drawn_change(true, self._of_logs, error, rng)
            ends = len(true.precision) + np.cumsum([0, *(len(c.names) for c in true.chosen)])
            values = [parameters[a:b] for a, b in pairwise(ends)]
            if all(plausible(HeldOutScore(c, 0.0, 0.0, v)) for c, v in zip(true.chosen, values, strict=True)):
                break
        else:
            parameters = mean
        left = true.remaining(parameters) / true.sigma  # what was measured less all of it
        for joint, rows in enumerate(true.rows):
            torque[:, joint] = rows[self._new, -1] - left[self._new, joint]
        return torque + self._error(error[~self._new], rng)

    def _error(self, error: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(S', n) over the background: segments of the model's error on the logs in any order."""
        count, n = int(self._new.sum()), error.shape[1]
        length = max(1, min(round(self._dataset.limits.block * self._dataset.rate), len(error) - 1))
        parts: list[np.ndarray] = []
        while sum(len(part) for part in parts) < count:
            at = int(rng.integers(len(error) - length))
            parts.append(error[at : at + length] * rng.choice([-1.0, 1.0]))
        larger = np.exp(_SCATTER * rng.standard_normal(n))
        sigma = self._dataset.fit.sigma  # at rest it is stiction's, not the model's
        return np.concatenate(parts)[:count] * larger * (sigma.min(axis=0) / sigma[self._new])


def _thin(dataset: Dataset) -> int:
    return max(1, round(dataset.rate / _RATE))


def _with_motion(dataset: Dataset, pieces: Sequence[GridMotion], load: Tool | None) -> Dataset:
    """The data of a diagnosis, thinned, and a motion after it whose torque is the model's."""
    fit, step, limits = dataset.fit, _thin(dataset), dataset.limits
    bare = fit.reference
    reference = bare if load is None else NominalModel(dataset.model, load)
    number = len(dataset.logs)
    after = max(s.started + float(s.time[-1]) for s in fit.signals)
    lengths = [len(s.time[s.kept]) for s in fit.signals]
    starts = np.cumsum([0, *lengths[:-1]])
    thin = np.concatenate([np.arange(a, a + length, step) for a, length in zip(starts, lengths, strict=True)])
    seen = [
        replace(
            s,
            time=s.time[s.kept][::step],
            q=s.q[s.kept][::step],
            qd=s.qd[s.kept][::step],
            qdd=s.qdd[s.kept][::step],
            kept=slice(None),
            low_pass=np.asarray,
        )
        for s in fit.signals
    ]
    new, begins = [], 0.0
    for piece in pieces:
        time = np.arange(piece.time[0], piece.time[-1], step / dataset.rate)
        q, qd, qdd = (_at(time, piece.time, values) for values in (piece.q, piece.qd, piece.qdd))
        time = time - time[0] + begins
        begins = float(time[-1]) + step / dataset.rate
        new.append(MotionSignals(reference, time, q, qd, qdd, number, started=after))
    sigma = np.concatenate([fit.sigma[thin], *(background_on(dataset, bare, one, new) for one in new)])
    columns = np.concatenate([reference.model.columns(one.q, one.qd, one.qdd) for one in new])
    unit = sigma[len(thin) :]
    rows = [
        np.concatenate([block[thin], np.column_stack([columns[:, j, index] / unit[:, j, None], np.zeros(len(unit))])])
        for j, (block, index) in enumerate(zip(fit.rows, fit.index, strict=True))
    ]
    time = np.concatenate([dataset.time[thin], *(one.time for one in new)])
    log = np.concatenate([dataset.log[thin], np.full(len(unit), number)])
    way = np.cumsum(
        [np.zeros(dataset.robot.dof), *(d for one in new for d in np.diff(one.q, axis=0, prepend=one.q[:1]))][1:],
        axis=0,
    )
    stub = replace(
        dataset.logs[-1], t=time[len(thin) :], position=way, cycle_starts=(), metadata={PARTS: PLANNED_PARTS}
    )
    logs = (*dataset.logs, stub)
    cell, folds, single = folds_of(time, log, logs, limits)
    block = np.concatenate([fit.block[thin], fit.block.max() + 1 + (time[len(thin) :] // limits.block).astype(int)])
    joined = Fit(
        bare, [*seen, *new], rows, fit.index, sigma, fit.precision, fit.shift, cell, block, folds, single, limits
    )
    return replace(
        dataset,
        fit=joined,
        residual=np.zeros_like(sigma),
        speed=np.concatenate([dataset.speed[thin], *(one.qd for one in new)]),
        time=time,
        log=log,
        logs=logs,
        rate=dataset.rate / step,
    )


def _at(time: np.ndarray, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(time, known, column) for column in values.T], axis=1)
