"""Groups of a simulator's numbers that are released together: friction, rotor, servo, load or link of a joint."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from agent.diagnosis.limits import LIMITS
from agent.diagnosis.rows.dataset import Dataset
from agent.diagnosis.rows.joined import joined
from agent.diagnosis.rows.servos import PositionLayout
from agent.model import FileNumbers
from agent.robot import ParameterLayout


class NumberKind(StrEnum):
    """Kinds of numbers that are released together; those that effects may be are `FileNumbers` too.

    A bend is how damping bends with speed, and an own delay how much later a joint's command is than that of the arm.
    A link has ten numbers, a load at the last one its mass and first moments.
    """

    FRICTION = FileNumbers.FRICTION
    ROTOR = "rotor inertia"
    LINK = "link inertia"
    LOAD = FileNumbers.LOAD
    GAIN = FileNumbers.GAIN
    BEND = "bend of damping"
    SPRING = FileNumbers.SPRING
    OFFSET = FileNumbers.OFFSET
    DELAY = FileNumbers.DELAY
    OWN_DELAY = "own delay"


@dataclass(frozen=True, eq=False)
class NumberGroup:
    """Parameters released together: `kind`, joint from 0 (-1: of all), directions (p, k).

    `scale` (k,) are the physical parameters' sizes, standard ones or friction's, of which the directions are images.
    """

    kind: NumberKind
    joint: int
    directions: np.ndarray
    scale: np.ndarray

    @property
    def key(self) -> tuple[NumberKind, int]:
        """Kind and joint."""
        return self.kind, self.joint

    @property
    def moves_links(self) -> bool:
        """Whether its parameters are inertias of links."""
        return self.kind in (NumberKind.LINK, NumberKind.LOAD)

    def text(self, names: Sequence[str]) -> str:
        """Name of the step."""
        if self.kind == NumberKind.LOAD:
            return f"{self.kind} at the link of {names[self.joint]}"
        return f"{self.kind} of {names[self.joint]}" if self.joint >= 0 else self.kind


def groups_of(dataset: Dataset) -> list[NumberGroup]:
    """All groups of numbers that may be released, the plainer kinds first.

    Of links the outermost comes first: what is mounted there counts with it.
    """
    model, reference = dataset.model, dataset.fit.reference
    layout, base = ParameterLayout.of(dataset.robot), len(model.independent)
    torque = np.sqrt(np.mean(joined(dataset.fit.signals, "predicted") ** 2, axis=0))
    stiffness = 1.0 if dataset.servos is None else dataset.servos.file.kp
    torque = np.maximum(torque, stiffness * np.sqrt(np.mean(dataset.residual**2, axis=0)))
    speed = np.maximum(np.sqrt(np.mean(dataset.speed**2, axis=0)), 1e-9)
    scale = reference.prior_std.copy()
    acceleration = joined(dataset.fit.signals, "qdd")
    fast = np.maximum(np.sqrt(np.mean(acceleration**2, axis=0)), 1e-9)
    # a file's rotor may be wrong by any factor, and of a wrist's inertia it is nearly all
    scale[layout.rotors] = np.maximum(scale[layout.rotors], torque / fast / dataset.robot.gear_ratios**2)
    size = len(dataset.fit.precision)
    friction: list[NumberGroup] = []
    rotors: list[NumberGroup] = []
    links: list[NumberGroup] = []
    for joint in range(dataset.robot.dof):
        terms = [k for k, term in enumerate(model.terms) if term.axle == joint]
        columns = np.zeros((size, len(terms)))
        for column, k in enumerate(terms):
            level = torque[joint] if model.terms[k].form == "coulomb" else torque[joint] / speed[joint]
            columns[base + k, column] = level
        friction.append(
            NumberGroup(NumberKind.FRICTION, joint, columns, columns[[base + k for k in terms], range(len(terms))])
        )
        for kind, place, groups in (
            (NumberKind.ROTOR, slice(layout.rotors.start + joint, layout.rotors.start + joint + 1), rotors),
            (NumberKind.LINK, layout.link(joint), links),
        ):
            directions = np.zeros((size, place.stop - place.start))
            directions[:base] = model.projection[:, place] * scale[place]
            if np.any(np.abs(directions) > 1e-12):
                groups.append(NumberGroup(kind, joint, directions, scale[place]))
    return [*friction, *_of_servos(dataset), *rotors, *load_groups(dataset), *reversed(links)]


def load_groups(dataset: Dataset) -> list[NumberGroup]:
    """A load at the last link, where positions are judged: next to gains, which it resembles, a link has too many
    numbers."""
    if (servos := dataset.servos) is None:
        return []
    model, last = dataset.model, dataset.robot.load_link
    load = servos.prior.load
    directions = np.zeros((servos.layout.size, load.shape[1]))
    directions[servos.layout.base] = model.projection[:, ParameterLayout.of(dataset.robot).link(last)] @ load
    return [NumberGroup(NumberKind.LOAD, last, directions, load[range(4), range(4)])]


def _of_servos(dataset: Dataset) -> list[NumberGroup]:
    """The gain of each servo, which may be wrong by any factor, its offset, and what the recorder does to commands."""
    if (servos := dataset.servos) is None:
        return []
    layout, prior = servos.layout, servos.prior
    delays = np.zeros((layout.size, 2 if prior.cut else 1))
    delays[layout.delay, 0] = prior.delay
    delays[layout.cut, 1:] = prior.cut
    own_delays = np.full(len(servos.file.kp), prior.delay)
    return [
        *([] if prior.kp_known else _one_by_one(NumberKind.GAIN, layout, layout.kp, servos.file.kp)),
        *_offsets(dataset),
        *([] if prior.spring is None else _one_by_one(NumberKind.SPRING, layout, layout.stiffness, prior.spring)),
        NumberGroup(NumberKind.DELAY, -1, delays, np.ones(delays.shape[1])),
        *([] if prior.one_delay else _one_by_one(NumberKind.OWN_DELAY, layout, layout.delay, own_delays)),
    ]


def _one_by_one(kind: NumberKind, layout: PositionLayout, place: slice, scale: np.ndarray) -> list[NumberGroup]:
    """One number of each joint by itself, which lie at `place` and are usually as large as `scale` (n,)."""
    columns = np.eye(layout.size)[place] * scale[:, None]
    return [NumberGroup(kind, j, columns[j][:, None], scale[j : j + 1]) for j in range(len(scale))]


def _offsets(dataset: Dataset, share: float = 1.0) -> list[NumberGroup]:
    """How far each servo stands off its set-points: by up to a `share` of its torque; none where torque is judged.

    A control of a unit of its own has its zero there instead.
    """
    if (servos := dataset.servos) is None:
        return []
    groups = _one_by_one(NumberKind.OFFSET, servos.layout, servos.layout.offset, share * servos.prior.offset)
    return [groups[j] for j in servos.prior.with_offset]


def drive_groups(dataset: Dataset, released: Collection[tuple[NumberKind, int]] = ()) -> list[NumberGroup]:
    """Friction, rotor and servo of every joint, the delay, and bends: all groups without links.

    Of offsets the usual ones but where they are `released`, by kind and joint: those are as large as the logs say.
    """
    groups = [group for group in groups_of(dataset) if not group.moves_links and group.kind != NumberKind.OFFSET]
    small = [group for group in usual_offsets(dataset) if group.key not in released]
    large = [group for group in _offsets(dataset) if group.key in released]
    return [*groups, *small, *large, *damping_bends(dataset)]


def usual_offsets(dataset: Dataset) -> list[NumberGroup]:
    """Offsets that a right file may have: as little of the torque as it misses anyway."""
    return _offsets(dataset, LIMITS.least_error)


def damping_bends(dataset: Dataset) -> list[NumberGroup]:
    """How much damping of each joint bends with speed, as grease does: no file has it, and no arm is without.

    A straight line takes a bend for Coulomb friction. None where torque is judged.
    """
    if (servos := dataset.servos) is None:
        return []
    speed = np.maximum(np.sqrt(np.mean(dataset.speed**2, axis=0)), 1e-9)
    viscous = [
        group.scale[-1] / speed[group.joint] for group in groups_of(dataset) if group.kind == NumberKind.FRICTION
    ]
    return _one_by_one(NumberKind.BEND, servos.layout, servos.layout.bend, np.array(viscous))


def open_numbers(dataset: Dataset) -> list[NumberGroup]:
    """Bends and usual offsets, and the delay where logs of positions leave open how the command was held: a right file
    may differ."""
    delays = [group for group in _of_servos(dataset) if group.kind == NumberKind.DELAY]
    usual = [*damping_bends(dataset), *usual_offsets(dataset)]
    return [*usual, *(delays if dataset.servos is not None and dataset.servos.later else ())]
