"""What these motions would show: of every effect in every place the smallest size that would be found."""

from __future__ import annotations

from collections.abc import Sequence

from agent.diagnosis.answer import NotTestable
from agent.diagnosis.candidate import Candidate, Where
from agent.diagnosis.dataset import Dataset
from agent.diagnosis.procedure import Search
from agent.model import CATALOGUE, Effect


def smallest_sizes(dataset: Dataset) -> dict[Where, float]:
    """Of every effect and place of torque the smallest size that four of five draws would show, over its practical one;
    infinite where these motions lack what it takes. What happens once has none."""
    search = Search(dataset.fit, given=dataset.given, limits=dataset.limits)
    search.scan(dataset.fit)
    found = {}
    for effect in CATALOGUE.values():
        if effect.shows_in == "path" or effect.once:
            continue
        for joints in effect.places(dataset.robot):
            forms = [candidate for candidate in search.tried if candidate.place == (effect.name, joints)]
            repeated = [candidate for candidate in forms if not candidate.once]
            if repeated or search.excursions.lacking(effect, joints):
                found[effect.name, joints] = _smallest(search, repeated)
    return found


def not_testable(dataset: Dataset, search: Search) -> list[NotTestable]:
    """Effects whose practical size would not be found on these motions, and why."""
    robot = dataset.robot
    names = robot.joint_names
    tried: dict[Where, list[Candidate]] = {}
    for candidate in search.tried:
        tried.setdefault(candidate.place, []).append(candidate)
    result = []
    for name, effect in CATALOGUE.items():
        if name not in search.allowed or effect.shows_in == "path":
            continue
        for joints in effect.places(robot):
            candidates = tried.get((name, joints), [])
            where = ", ".join(names[j] for j in joints) or None
            if not candidates:
                why = search.excursions.lacking(effect, joints) or effect.why_absent
                if why:
                    result.append(NotTestable(name, where, why))
                continue
            candidates = [candidate for candidate in candidates if not candidate.once]
            if not candidates:
                continue
            if search.moved:  # in its plainest form: links that were moved may do all that this does
                fewest = min(effect.n_parameters(candidate.settings) for candidate in candidates)
                candidates = [c for c in candidates if effect.n_parameters(c.settings) == fewest]
            size = _smallest(search, candidates)
            if size > 1:
                result.append(NotTestable(name, where, _why_small(effect, size, dataset.given, search.moved)))
    if all(log.planned_position is None or log.reference_position is None for log in dataset.logs):
        lacking = [
            name
            for name, of_logs in (
                ("planned", [log.planned_position for log in dataset.logs]),
                ("executed", [log.reference_position for log in dataset.logs]),
            )
            if all(rows is None for rows in of_logs)
        ]
        why = f"the logs lack {' and '.join(lacking) or 'planned beside executed'} set-points"
        result += [NotTestable(name, None, why) for name in effects_of_path()]
    return result


def effects_of_path() -> list[str]:
    """Effects that show in the set-points alone."""
    return [name for name, effect in CATALOGUE.items() if effect.shows_in == "path"]


def _smallest(search: Search, forms: Sequence[Candidate]) -> float:
    assert search.null is not None
    sizes = (search.null.minimum_detectable_size(form, search.least) for form in forms)
    return min(sizes, default=float("inf"))


def _why_small(effect: Effect, size: float, given: bool, moved: bool) -> str:
    """`size` in practical sizes: the smallest that would be found."""
    if not given:
        return "no model was given: the fit to these logs absorbs it"
    found = f"it would be found from {100 * size * effect.practical:.1f} % of nominal torque on"
    if size * effect.practical > 5:
        found = "none of any size would be found"
    beside = ", and beside the numbers of the simulator that were moved," if moved else ""
    return (
        f"on these motions{beside} {found} (1 % false alarms, 80 % power), and it "
        f"matters from {100 * effect.practical:.1f} % on"
    )
