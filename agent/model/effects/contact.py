"""External force on the arm during short windows of time.

The search runs in four steps: windows in which a constant force on a link leaves the least error (`Windows`), the
windows that stand out from all others (`strongest`), the shape of the force in each (`shaped`), and the point on the
link where each force acts (`force_point`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapify, heappop, heappush
from types import MappingProxyType

import numpy as np

from agent.model.effect_inputs import MotionSignals, NominalModel
from agent.model.effects.effect import Columns, Effect, FitContext, Joints, Numbers

#: numerical: shares of the duration over which a force rises, and falls, each for itself where the torque tells it
_EDGES = (0.02, 0.15, 0.5, 0.85, 0.98)
_EDGE = _EDGES[1]  # usual
_LINKS = 3  # numerical: links tried for the case that all pushes act on one link
_DURATIONS = np.geomspace(0.2, 12.0, 14).tolist()  # s
_STARTS = 0.05  # numerical: s between starts of windows
_USUAL, _STANDS_OUT = 0.9, 3.0  # quantile of windows as long; factor above it, and above other cycles'
_SHARP = 30.0  # the same factor for one with no quiet time before it, or that repeats with the cycle next to another
_BORDER = _DURATIONS[0]  # s: what is nearer than the shortest push is as good as the same moment
_LEAST_GAIN_RATIO = 0.02  # least gain over that of the strongest push; of a pause over that of its push
_FEW, _RARE = 6, 0.15  # pushes of any duration; share of the time that more pushes may take
_END_STEPS = 4  # numerical: steps by which each end moves while the shape is searched, over nearly half its duration
_EDGE_STEPS, _EDGE_PARTS = 8, 40  # numerical: steps by which each end moves in the fit; steps per duration
#: numerical: starts of the parts that are checked for a pause, per duration: as long as an edge, between the edges
_PARTS = np.linspace(_EDGE, 1 - 2 * _EDGE, 10)
_UNKNOWN = -1  # numerical: whether a window has a pause
_LOOK = 16  # numerical: windows that are looked at for a pause together, the strongest first
_ROUNDS = 30  # numerical: alternating fits of force and point
_WEAK = 1e-6  # regularisation over the mean information: moving the point along the force changes no torque


class Contact(Effect):
    """τ = −J_lᵀ F during one or several windows, at one point of link l each, while F rises, is constant and falls.

    The point is the far end of the link, unless another one leaves less error.
    """

    name = "contact"
    family = "load"
    scope = "arm"
    formula = "−J_l(q)ᵀ · F · window(t), l any link"
    source = "Haddadin, De Luca, Albu-Schäffer, IEEE Trans. Robotics 33 (2017)"
    signature = "residual in one segment of time that does not come back with the next cycle"
    confused_with = ()
    phrase = "something pushed the arm for a while"
    look_at = "what the arm touched at that time: a person, a fixture, a caught hose"
    units = MappingProxyType({"force": "N", "at": "m", "start": "s", "end": "s", "duration": "s"})
    leading = ("force_x",)
    components = ("force", ("force_x", "force_y", "force_z"))
    residual_driven = True
    transient = True

    def settings(self, context: FitContext, joints: Joints) -> list[dict[str, float]]:
        """The strongest windows that do not overlap, in sets of growing size.

        All pushes act on the link that explains most, or each on its own link; at its far end, or where it fits best.
        Model error and drift make windows too. So a contact must stand out from the windows before and after it, and
        must not repeat at the same phase of the next cycle.
        """
        dof = context.reference.robot.dof
        motions = list(zip(context.signals, context.residuals_as_given, context.sigmas, strict=True))
        windows = [window for link in range(dof) for part in motions for window in Windows.of(link, *part)]
        by_link = [strongest([w for w in windows if w.link == link]) for link in range(dof)]
        by_link = sorted(by_link, key=lambda pushes: -sum(push.gain for push in pushes))[:_LINKS]
        sets = [pushes for pushes in (*by_link, strongest(windows)) if pushes]
        tried = [_settings(pushes[:count]) for pushes in sets for count in range(1, len(pushes) + 1)]
        in_shape = [[shaped(push, motions) for push in pushes] for pushes in sets]
        tried += [_settings(pushes) for pushes in in_shape]
        tried += [_settings(pushes, [force_point(push, motions) for push in pushes]) for pushes in (*sets, *in_shape)]
        return list({str(entry): entry for entry in tried}.values())

    def names(self, settings: Numbers) -> tuple[str, ...]:
        return tuple(f"force_{axis}_{number}" for number in _numbers(settings) for axis in "xyz")

    def columns(self, signals: MotionSignals, joints: Joints, settings: Numbers) -> Columns:
        n = signals.q.shape[1]
        numbers = _numbers(settings)
        block = np.zeros((len(signals.time), n, 3 * len(numbers)))
        for index, number in enumerate(numbers):
            log, link, start, lasting = (settings[f"{key}_{number}"] for key in ("log", "link", "start", "duration"))
            if signals.log_index != log:
                continue
            rise, fall = (settings.get(f"{edge}_{number}", _EDGE) for edge in ("rise", "fall"))
            window = _window(signals.time - start, lasting, rise, fall)
            inside = window > 0
            place = [settings.get(f"{axis}_{number}", 0.0) for axis in "xyz"]
            pushed = np.swapaxes(signals.pushed(int(link) - 1, inside, place), 1, 2)
            block[inside, :, 3 * index : 3 * index + 3] = -pushed * window[inside, None, None]
        return {joint: block[:, joint] for joint in range(n)}

    def prior_precision(self, context: FitContext, joints: Joints, settings: Numbers) -> np.ndarray | None:
        """Usual force: what the strongest joint holds at full reach. A force that turns no joint stays small."""
        usual = float(context.reference.scale.max()) / context.reference.reach
        return np.eye(len(self.names(settings))) / usual**2

    def reported(self, reference: NominalModel, settings: Numbers, values: Numbers) -> dict[str, float]:
        """Per push: link (from 1), force [N, base frame], log (from 0), start and end [s].

        If it does not act at the far end of the link, also its point [m] from there, in the link's frame.
        """
        numbers: dict[str, float] = {}
        for number in _numbers(settings):
            start = settings[f"start_{number}"]
            of_push = {"link": settings[f"link_{number}"]}
            of_push |= {f"force_{axis}": values[f"force_{axis}_{number}"] for axis in "xyz"}
            of_push |= {"log": settings[f"log_{number}"], "start": start, "end": start + settings[f"duration_{number}"]}
            of_push |= {f"at_{axis}": settings[f"{axis}_{number}"] for axis in "xyz" if f"{axis}_{number}" in settings}
            numbers |= {key if number == 1 else f"{key}_{number}": value for key, value in of_push.items()}
        return numbers


def _settings(pushes: Sequence[PushedWindow], places: Sequence[np.ndarray | None] = ()) -> dict[str, float]:
    entries: dict[str, float] = {}
    for number, push in enumerate(pushes, start=1):
        of_push = {"log": push.log, "link": push.link + 1, "start": push.start, "duration": push.duration}
        if (push.rise, push.fall) != (_EDGE, _EDGE):
            of_push |= {"rise": push.rise, "fall": push.fall}
        if places and (point := places[number - 1]) is not None:
            of_push |= dict(zip("xyz", point.tolist(), strict=True))
        entries |= {f"{key}_{number}": float(value) for key, value in of_push.items()}
    return entries


_Share = float | np.ndarray


def _window(since: np.ndarray, lasting: _Share, rise: _Share, fall: _Share) -> np.ndarray:
    """Share of a force at times since the middle of its rise; it lasts until the middle of its fall. `rise` and `fall`
    are shares of the whole duration."""
    duration = lasting / (1 - 0.5 * (rise + fall))
    since = since + 0.5 * rise * duration
    return np.clip(np.minimum(since / (rise * duration), (duration - since) / (fall * duration)), 0, 1)


def _numbers(settings: Numbers) -> list[int]:
    """Numbers of the pushes, from 1."""
    return [int(key.removeprefix("link_")) for key in settings if key.startswith("link_")]


@dataclass(frozen=True)
class PushedWindow:
    """A window in which a force on a link lowers the squared error by `gain`."""

    gain: float
    link: int
    log: int
    start: float
    duration: float
    rise: float = _EDGE
    fall: float = _EDGE

    def meets(self, other: PushedWindow) -> bool:
        """Whether another push shares time with it."""
        apart = other.start >= self.start + self.duration or other.start + other.duration <= self.start
        return other.log == self.log and not apart

    def only_meets(self, other: PushedWindow, late: float) -> bool:
        """Whether it shares time with another `late` [s], neither end with that one's."""
        start, end = other.start + late, other.start + other.duration + late
        apart = abs(self.start - start), abs(self.start + self.duration - end)
        shared = self.start < end and self.start + self.duration > start
        return shared and min(apart) > max(_BORDER, other.duration / _EDGE_PARTS)

    def overlaps(self, starts: np.ndarray, duration: float) -> np.ndarray:
        """(K,) bool: which windows of its log it shares time with."""
        return (starts < self.start + self.duration) & (starts + duration > self.start)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Running sums over the rows of one motion, time (S',) [s]: moments (S', 3, 3) of the columns of a force, and with
    the error (S', 3). `inverses` (K, 3, 3) of the moments of all windows, by their length: they outlast the error."""

    time: np.ndarray
    gram: np.ndarray
    side: np.ndarray
    inverses: dict[float, np.ndarray]

    def between(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moments (K, 3, 3) of the force's columns, and with the error (K, 3), from `starts` to `ends` (K,) [s]."""
        first = np.searchsorted(self.time, starts)
        last = np.minimum(np.searchsorted(self.time, ends), len(self.time) - 1)
        return self.gram[last] - self.gram[first], self.side[last] - self.side[first]

    def forces(self, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(K,) what a constant force takes away from `starts` to `ends` (K,) [s], and that force (K, 3) [N]."""
        moments, pull = self.between(starts, ends)
        force = np.linalg.solve(_regular(moments), pull[:, :, None])[:, :, 0]
        return np.einsum("ka,ka->k", pull, force), force

    def every_force(self, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts (K,) [s] of all windows of a length, and `forces` of these."""
        starts = np.arange(self.time[0], self.time[-1] - duration, _STARTS)
        first = np.searchsorted(self.time, starts)
        last = np.minimum(np.searchsorted(self.time, starts + duration), len(self.time) - 1)
        if duration not in self.inverses:
            self.inverses[duration] = np.linalg.inv(_regular(self.gram[last] - self.gram[first]))
        pull = self.side[last] - self.side[first]
        force = (self.inverses[duration] @ pull[:, :, None])[:, :, 0]
        return starts, np.einsum("ka,ka->k", pull, force), force

    def whole(self, starts: np.ndarray, duration: float, gain: np.ndarray, force: np.ndarray) -> np.ndarray:
        """(K,) bool: which forces (K, 3) [N] from `starts` for `duration` [s] leave less error in every part of it than
        none there, as far as it would show: else there are two with a pause between."""
        if duration * _EDGE < _DURATIONS[0] / 2:
            return np.ones(len(starts), dtype=bool)
        begin = starts + _PARTS[:, None] * duration  # (P, K)
        moments, pull = self.between(begin, begin + _EDGE * duration)
        expected = np.einsum("pkab,ka,kb->pk", moments, force, force)
        lost = expected / 2 - np.einsum("pka,ka->pk", pull, force)
        return np.all(lost <= _LEAST_GAIN_RATIO * gain, axis=0)


@dataclass(frozen=True, eq=False)
class Windows:
    """All windows of a length in one motion: starts (K,) [s], gain (K,) of a force (K, 3) on a link, by its `sums`."""

    link: int
    log: int
    duration: float
    starts: np.ndarray
    gain: np.ndarray
    force: np.ndarray
    cycle_starts: Sequence[float]
    sums: _Sums

    @classmethod
    def of(cls, link: int, signals: MotionSignals, residual: np.ndarray, sigma: np.ndarray) -> Iterator[Windows]:
        """Windows of every length from running sums over the rows: moments of the force's columns and the error."""
        rows = np.zeros(len(signals.time), dtype=bool)
        rows[signals.kept] = True
        columns, gram, inverses = _force(link, signals, rows, sigma)
        side = np.cumsum(np.einsum("san,sn->sa", columns, residual / sigma), axis=0)
        time = signals.time[signals.kept]
        sums = _Sums(time, gram, side, inverses)
        for duration in _DURATIONS:
            if duration > time[-1] - time[0]:
                return
            starts, gain, force = sums.every_force(duration)
            yield cls(link, signals.log_index, duration, starts, gain, force, signals.cycle_starts, sums)

    @cached_property
    def strongest(self) -> PushedWindow | None:
        """The strongest window."""
        return self.best([])

    def best(self, taken: Sequence[PushedWindow]) -> PushedWindow | None:
        """The strongest window without a pause in it that shares no time with those taken."""
        shared = self.shared(taken)
        order = self._order[~shared[self._order]]
        for first in range(0, len(order), _LOOK):
            some = order[first : first + _LOOK]
            new = some[self._without_pause[some] == _UNKNOWN]
            if len(new):
                self._without_pause[new] = self.sums.whole(
                    self.starts[new], self.duration, self.gain[new], self.force[new]
                )
            whole = self._without_pause[some] == 1
            if whole.any():
                k = int(some[np.argmax(whole)])
                return PushedWindow(float(self.gain[k]), self.link, self.log, float(self.starts[k]), self.duration)
        return None

    @cached_property
    def _order(self) -> np.ndarray:
        """(K,) windows, the strongest first."""
        return np.argsort(-self.gain, kind="stable")

    @cached_property
    def _without_pause(self) -> np.ndarray:
        """(K,) whether windows have no pause, as far as that is known."""
        return np.full(len(self.starts), _UNKNOWN, dtype=np.int8)

    def fitted(self, push: PushedWindow, taken: Sequence[PushedWindow]) -> PushedWindow:
        """A push with both ends moved to where it gains most, so that no remainder shows next to it."""
        step = max(_STARTS, push.duration / _EDGE_PARTS)
        moved = step * np.arange(-_EDGE_STEPS, _EDGE_STEPS + 1)
        starts, ends = (part.ravel() for part in np.meshgrid(push.start + moved, push.start + push.duration + moved))
        free = (starts >= self.starts[0] + (0 if self.bare(push) else _BORDER)) & (ends <= self.sums.time[-1])
        free &= ends - starts >= _DURATIONS[0] - 1e-9
        for other in taken:
            free &= (other.log != self.log) | (starts >= other.start + other.duration) | (ends <= other.start)
        if not free.any():
            return push
        starts, ends = starts[free], ends[free]
        gain, _ = self.sums.forces(starts, ends)
        k = int(np.argmax(gain))
        return PushedWindow(float(gain[k]), self.link, self.log, float(starts[k]), float(ends[k] - starts[k]))

    def bare(self, push: PushedWindow) -> bool:
        """Whether a push starts with the samples, so that there is no quiet time before it to compare with."""
        return push.log == self.log and push.start < self.starts[0] + _BORDER

    def near(self, push: PushedWindow, free: np.ndarray) -> float:
        """Largest gain of the windows right before and after a push that are `free` (K,) of any other."""
        around = (np.abs(self.starts - push.start) <= 2 * push.duration) & free  # as long before and after as it lasts
        return float(self.gain[around].max(initial=0.0))

    def gain_next_to(self, push: PushedWindow) -> float:
        """Largest gain a second of the windows that end just before a push or begin just after it."""
        before, after = push.start - self.duration - self.starts, self.starts - push.start - push.duration
        close = [(gap >= _STARTS) & (gap <= _BORDER) for gap in (before, after)]
        return float(self.gain[close[0] | close[1]].max(initial=0.0)) / self.duration

    def gain_at_phase(self, push: PushedWindow, taken: Sequence[PushedWindow]) -> float:
        """Largest gain at the same phase of another cycle, within one step; 0 without cycles.

        Another push that overlaps this phase but shares neither end is no repetition.
        """
        edges = np.asarray(self.cycle_starts, dtype=float)
        cycle = int(np.searchsorted(edges, push.start + 1e-9)) - 1
        if len(edges) < 2 or cycle < 0:
            return 0.0
        others = [other for other in taken if other.log == self.log and other is not push]
        shifts = np.delete(edges, cycle) - edges[cycle]
        places = [push.start + by for by in shifts if not any(other.only_meets(push, by) for other in others)]
        return max(
            (float(self.gain[np.abs(self.starts - time) < 2 * _STARTS].max(initial=0.0)) for time in places),
            default=0,
        )

    def shared(self, taken: Sequence[PushedWindow]) -> np.ndarray:
        """(K,) bool: windows that share time with a push."""
        shared = np.zeros(len(self.starts), dtype=bool)
        for push in taken:
            if push.log == self.log:
                shared |= push.overlaps(self.starts, self.duration)
        return shared


def _regular(moments: np.ndarray) -> np.ndarray:
    """(…, k, k) moments that have an inverse, also where a force turns no joint."""
    weak = _WEAK * np.trace(moments, axis1=-2, axis2=-1) + 1e-12
    return np.asarray(moments + weak[..., None, None] * np.eye(moments.shape[-1]))


def _force(
    link: int, signals: MotionSignals, rows: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[float, np.ndarray]]:
    """(S', 3, n) columns of a force on a link over `sigma`, running sums (S', 3, 3) of their moments, and inverses.

    Every scan of a search needs them, with another error each time.
    """
    by_link = signals.memory.setdefault("forces", {})
    if link not in by_link or not np.array_equal(by_link[link][0], sigma):
        columns = -signals.pushed(link, rows) / sigma[:, None]
        by_link[link] = sigma, columns, np.cumsum(np.einsum("san,sbn->sab", columns, columns), axis=0), {}
    return by_link[link][1:]


def strongest(windows: Sequence[Windows]) -> list[PushedWindow]:
    """The strongest windows that stand out and do not overlap; strongest first."""
    taken: list[PushedWindow] = []
    # a length's window is looked for once nothing else can be stronger than the most that any of it gains
    heap = [(-float(w.gain.max(initial=0.0)), number) for number, w in enumerate(windows)]
    heapify(heap)
    best: dict[int, tuple[PushedWindow, int]] = {}  # and how many were taken then
    spans = [(w.log, float(np.ptp(w.starts)) + w.duration) for w in windows if len(w.starts)]
    lasting = sum(max(span for log, span in spans if log == index) for index in {log for log, _ in spans})
    while heap:
        number = heappop(heap)[1]
        of_length = windows[number]
        if number not in best or any(other.meets(best[number][0]) for other in taken[best[number][1] :]):
            next_window = of_length.best(taken) if taken else of_length.strongest
            if next_window is not None:
                best[number] = next_window, len(taken)
                heappush(heap, (-next_window.gain, number))
            continue
        push = best[number][0]
        if taken and push.gain < _LEAST_GAIN_RATIO * taken[0].gain:
            break
        last = of_length.fitted(push, taken)
        if len(taken) >= _FEW and sum(p.duration for p in (*taken, last)) > _RARE * lasting:
            break  # many windows can follow any torque
        taken.append(last)
        heappush(heap, (-push.gain, number))
    free = [(w, ~w.shared(taken)) for w in windows]
    compared = [(push, *_usual_and_repeated(push, taken, free)) for push in taken]
    bare = [push for push in taken if any(w.bare(push) for w in windows)]
    alone = [
        push
        for push, around, repeated in compared
        if push.gain > max((_SHARP if push in bare else _STANDS_OUT) * around, _STANDS_OUT * repeated)
    ]
    # next to a push that does not repeat, one that repeats counts too if nothing around it is similar
    return [p for p, around, _ in compared if p in alone or (alone and p.gain > _SHARP * around)]


#: Windows, and which of them (K,) share no time with a push.
Free = Sequence[tuple[Windows, np.ndarray]]


def _usual_and_repeated(push: PushedWindow, taken: Sequence[PushedWindow], windows: Free) -> tuple[float, float]:
    """Gain that is usual or near a push, and the gain that repeats at its phase of another cycle."""
    of_link = [(w, free) for w, free in windows if w.link == push.link]
    of_log = [(w, free) for w, free in of_link if w.log == push.log]
    as_long = min((w.duration for w, _ in of_log), key=lambda duration: abs(duration - push.duration))
    scale = push.duration / as_long
    usual = _usual_gain(push, of_link)
    repeated = scale * max((w.gain_at_phase(push, taken) for w, _ in of_log if w.duration == as_long), default=0.0)
    near = scale * max((w.near(push, free) for w, free in of_log if w.duration == as_long), default=0.0)
    shortest = [w for w, _ in of_log if w.duration == _DURATIONS[0]]
    return max(usual, near, push.duration * max((w.gain_next_to(push) for w in shortest), default=0.0)), repeated


def _usual_gain(push: PushedWindow, windows: Free) -> float:
    """Usual gain of a window as long as a push, scaled up from shorter windows if no such window is free.

    Infinite if no window is free: a force from the first sample to the last is no event.
    """
    for duration in (length for length in reversed(_DURATIONS) if length <= push.duration):
        parts = [w.gain[free] for w, free in windows if w.duration == duration]
        others = np.concatenate([np.zeros(0), *parts])
        if len(others):
            return float(np.quantile(others, _USUAL)) * push.duration / duration
    return np.inf


#: Per motion its signals, and the error and noise level (S', n) of the rows that are kept.
Motions = Sequence[tuple[MotionSignals, np.ndarray, np.ndarray]]


def shaped(push: PushedWindow, motions: Motions) -> PushedWindow:
    """A push with the rise and fall that gain most, and its ends moved to where they do; as it is, if nothing does.

    Args:
        push: with the usual edges.
        motions: that it is one of the logs of.
    """
    time, columns, error = _surroundings(push, motions)
    squares = np.einsum("san,sbn->sab", columns, columns).reshape(len(time), 9)
    pull = np.einsum("san,sn->sa", columns, error)
    moved = push.duration * np.arange(-_END_STEPS, _END_STEPS + 1) / (2 * _END_STEPS + 1)
    first, last = (part.ravel() for part in np.meshgrid(push.start + moved, push.start + push.duration + moved))
    shapes = [(rise, fall) for rise in _EDGES for fall in _EDGES if rise + fall <= 1]
    tried = [(push.start, push.duration, push.rise, push.fall)]
    tried += [(a, b - a, *shape) for shape in shapes for a, b in zip(first.tolist(), last.tolist(), strict=True)]
    begin, *shape_of = np.array(tried).T[:, :, None]
    share = _window(time - begin, *shape_of)
    moments, sides = (share**2 @ squares).reshape(-1, 3, 3), share @ pull
    gain = np.einsum("ka,ka->k", sides, _solved(moments, sides))
    start, duration, rise, fall = tried[int(np.argmax(gain))]
    return replace(push, start=start, duration=duration, rise=rise, fall=fall)


def _surroundings(push: PushedWindow, motions: Motions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time (K,) [s], columns (K, 3, n) of a force and error (K, n) over σ, from well before a push to well after."""
    parts = []
    for signals, residual, sigma in motions:
        if signals.log_index != push.log:
            continue
        time = signals.time[signals.kept]
        window = np.abs(time - push.start - 0.5 * push.duration) < 2 * push.duration
        rows = np.zeros(len(signals.time), dtype=bool)
        rows[signals.kept] = window
        parts.append((time[window], -signals.pushed(push.link, rows) / sigma[window, None], (residual / sigma)[window]))
    time, columns, error = (np.concatenate(part) for part in zip(*parts, strict=True))
    return time, columns, error


def force_point(push: PushedWindow, motions: Motions) -> np.ndarray | None:
    """(3,) [m] from the far end of a push's link, in the link's frame; None where that would be off the link.

    The torque J(p)ᵀ F of a force F at a point p of the link is linear in F for fixed p, and in p for fixed F. So both
    are fitted in turns (alternating least squares), which never increases the error. The fit starts at the far end.

    Args:
        push: whose point is searched.
        motions: that it is one of the logs of.
    """
    moments, side, farthest = np.zeros((12, 12)), np.zeros(12), 0.0
    for signals, residual, sigma in motions:
        time = signals.time[signals.kept]
        inside = (time >= push.start) & (time <= push.start + push.duration)
        if signals.log_index != push.log or not inside.any():
            continue
        rows = np.zeros(len(signals.time), dtype=bool)
        rows[signals.kept] = inside
        end = signals.pushed(push.link, rows)
        levers = [signals.pushed(push.link, rows, along) - end for along in np.eye(3)]
        columns = -np.concatenate([end, *levers], axis=1) / sigma[inside, None]
        moments += np.einsum("san,sbn->ab", columns, columns)
        side += np.einsum("san,sn->a", columns, (residual / sigma)[inside])
        reference = signals.reference  # a link that is short in one direction is as large as the mean one in another
        length = float(np.linalg.norm(reference.links.link_ends()[push.link]))
        farthest = max(length, reference.reach / reference.robot.dof)
    point = np.zeros(3)
    for _ in range(_ROUNDS):
        of_force = np.kron(np.append(1.0, point), np.eye(3)).T
        force = _solved(of_force.T @ moments @ of_force, of_force.T @ side)
        fixed = np.concatenate([force, np.zeros(9)])
        of_point = np.vstack([np.zeros((3, 3)), np.kron(np.eye(3), force[:, None])])
        point = _solved(of_point.T @ moments @ of_point, of_point.T @ (side - moments @ fixed))
    return point if np.linalg.norm(point) < farthest else None


def _solved(moments: np.ndarray, side: np.ndarray) -> np.ndarray:
    """(…, k) solutions for moments (…, k, k) and sides (…, k)."""
    return np.asarray(np.linalg.solve(_regular(moments), side[..., None])[..., 0])
