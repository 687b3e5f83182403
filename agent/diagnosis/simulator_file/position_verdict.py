"""The verdict on positions: which effects and moved numbers have a size, and whether what is left is no chance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from agent.diagnosis.document import Cause, NamedEffect
from agent.diagnosis.gap.adequacy import Adequacy, remainders
from agent.diagnosis.gap.torque_gap import rms
from agent.diagnosis.limits import LIMITS
from agent.diagnosis.simulator_file.explanation import Explanation
from agent.diagnosis.simulator_file.numbers_as_causes import NAMES, causes_of_numbers
from agent.diagnosis.simulator_file.parameter_groups import open_numbers
from agent.diagnosis.simulator_file.released_numbers import released_fit
from agent.diagnosis.simulator_file.servo_table import differing_causes, doubtful_gains
from agent.diagnosis.verdict import Verdict, causes_of, decide_by_position, has_size
from agent.model import CATALOGUE, FileNumbers


def verdict_on_positions(explanation: Explanation) -> Verdict:
    """The verdict on effects and moved numbers of a file that was judged by its free motion.

    An effect has its size in what the numbers leave. A number counts on joints that err by more than a right file does.
    """
    dataset, selected, gap = explanation.dataset, explanation.selected, explanation.as_given
    names, released = dataset.robot.joint_names, explanation.released
    with_remainder = {names.index(part.joint) for part in remainders(dataset, explanation.gap)}
    numbers = causes_of_numbers(released, selected, gap, doubtful_gains(explanation), with_remainder)
    beyond = causes_of(dataset, selected, Adequacy.of(selected, explanation.gap))
    sizes = explanation.causes_as_given, beyond
    effects = [as_given for as_given, beyond_numbers in zip(*sizes, strict=True) if has_size(beyond_numbers)]
    errs = selected.fit.beyond_usual(gap.rmse_before)
    where_it_errs = [
        cause
        for cause in filter(has_size, numbers)
        if errs[[names.index(name) for name in cause.joints or names]].any()
    ]
    wrong_numbers = differing_causes(explanation, where_it_errs)
    file = released.given
    left_open = rms(gap.beyond(released_fit(file, open_numbers(file)).held_out()))
    beyond_chance = bool(file.fit.beyond_chance(np.minimum(gap.rmse_before, left_open)).any())
    if beyond_chance and not (effects or wrong_numbers) and (gap.closure or 0.0) >= LIMITS.explained:
        wrong_numbers = _as_class(where_it_errs)
    return decide_by_position(effects, wrong_numbers, gap.closure, beyond_chance)


def _as_class(causes: Sequence[Cause]) -> list[Cause]:
    """Numbers each of which may be the file's, but not all: the one that closes most, with what may be wrong instead.

    In slow motion a delay and damping of a joint are one number, so its friction is in the class of a delay.
    """
    if not causes:
        return []
    leader, *others = causes
    equivalent = [NamedEffect(other.effect, other.joints) for other in others]
    if CATALOGUE[leader.effect].numbers == FileNumbers.DELAY:
        equivalent.append(NamedEffect(NAMES[FileNumbers.FRICTION], leader.joints))
    return [replace(leader, equivalent_to=tuple(dict.fromkeys((*leader.equivalent_to, *equivalent))))]
