"""The identified load of a model in the formats of robot vendors.

The load is what the arm carries beyond the bodies of its model: mass [kg], centre of mass [m] and inertia [kg·m²] about
it, in the axes of the flange (`flange_of`). Sources of each vendor's fields, units and order:

- Universal Robots Script Manual, `set_target_payload`
- ABB RAPID reference, `loaddata`
- KUKA System Software, `LOAD_DATA`
- Franka RIDE, end effector commissioning
- COMAU PDL2, `$TOOL_MASS`, `$TOOL_CNTR`, `$TOOL_INERTIA`
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from agent.core import InputError, RejectedError
from agent.model import CATALOGUE, FileNumbers, IdentifiedModel, ModelEffect, seen_from
from agent.robot import LINK_PARAMETERS, ParameterLayout, about_centre
from agent.simulators.flange import flange_of

_MOMENT = ("moment_x", "moment_y", "moment_z")
_INERTIA = tuple(f"inertia_{axes}" for axes in ("xx", "xy", "yy", "xz", "yz", "zz"))
_ROUND_OFF, _UNFELT = 1e-9, 1e6  # kg·m, where no torque of the arm depends on a moment
#: m²: 2 |c| δ, by which an inertia about the centre is off where a centre at |c| = 0.5 m is rounded to δ = 1 µm.
_ROUNDED = 1e-6


@dataclass(frozen=True, eq=False)
class IdentifiedLoad:
    """Mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about it in the axes of the frame `flange`.

    `chosen`: why this frame is the flange.

    `mass_error`, `centre_error` (3,) and `inertia_error` are half the 95 % intervals; None where the model has none.
    """

    flange: str
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    chosen: str
    mass_error: float | None = None
    centre_error: np.ndarray | None = None
    inertia_error: float | None = None

    def principal(self) -> tuple[np.ndarray, Rotation]:
        """(3,) principal moments, and the right-handed rotation of their axes that is closest to the flange's."""
        moments, axes = np.linalg.eigh(self.inertia)
        orders = [list(columns) for columns in permutations(range(3))]
        order = orders[int(np.argmax([np.abs(np.diag(axes[:, columns])).sum() for columns in orders]))]
        axes = axes[:, order] * np.where(np.diag(axes[:, order]) < 0, -1.0, 1.0)
        if np.linalg.det(axes) < 0:
            axes[:, np.argmin(np.diag(axes))] *= -1
        return moments[order], Rotation.from_matrix(axes)


def identified_load(model: IdentifiedModel, flange: str | None = None) -> IdentifiedLoad:
    """The load of a model: the sum of what it adds to the link that carries a load; `flange` names its frame.

    Raises:
        InputError: it has none, or the flange is not known.
        RejectedError: its mass or inertia is impossible for a body.
    """
    robot = model.robot
    entries = [load for load in (_load_of(entry, robot.load_link) for entry in model.effects) if load is not None]
    if not entries:
        raise InputError(
            "the model has no identified load, so there is none to export: find one with agent diagnose --model MODEL "
            "LOG... -o WITH_LOAD.json, on logs with the load mounted, and export that model"
        )
    frame = flange_of(robot, flange)
    block = np.sum([_parameters(_at_least_a_point(entry), robot.dof) for entry in entries], axis=0)
    if block[0] <= 0:
        raise RejectedError(
            f"the identified load has a mass of {block[0]:.3g} kg: the arm carries less than its model, and no vendor "
            "takes a negative load; reduce the load that is entered in the controller by it"
        )
    unfelt = ~np.any(model.projection[:, ParameterLayout.of(robot).link(robot.dof - 1)][:, 1:4], axis=0)
    errors = _errors(entries[0], frame.pose[:3, :3], unfelt) if len(entries) == 1 else (None, None, None)
    at_flange = seen_from(block, frame.pose)
    inertia = _possible_inertia(about_centre(at_flange), float(at_flange[0]))
    return IdentifiedLoad(
        frame.frame, float(at_flange[0]), at_flange[1:4] / at_flange[0], inertia, frame.chosen, *errors
    )


def _possible_inertia(inertia: np.ndarray, mass: float) -> np.ndarray:
    """(3, 3) [kg·m²] of a body of that mass [kg] where only rounding makes the given one impossible.

    Raises:
        RejectedError: no body is near.
    """
    inertia = np.where(np.abs(inertia) < _ROUND_OFF * mass, 0.0, inertia)
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia  # of a body, its eigenvalues are not negative
    values, axes = np.linalg.eigh(second)
    if values[0] >= 0:
        return inertia
    if values[0] < -_ROUNDED * mass:
        low, middle, high = np.linalg.eigvalsh(inertia)
        raise RejectedError(
            f"the identified load has principal moments of inertia {low:.3g}, {middle:.3g} and {high:.3g} kg·m²: no "
            "body has them (the two smallest add up to at least the largest), so nothing is exported; record motion "
            "that turns the wrist faster"
        )
    second = (axes * np.maximum(values, 0.0)) @ axes.T
    return np.asarray(np.trace(second) * np.eye(3) - second)


def _load_of(entry: ModelEffect, link: int) -> ModelEffect | None:
    """The entry as a load: itself, or other inertial parameters of the link that carries one, which torque does not
    distinguish from it; None where it is neither."""
    numbers = CATALOGUE[entry.effect].numbers
    if numbers != FileNumbers.LINKS or int(entry.parameters["link"]) != link + 1:
        return entry if numbers == FileNumbers.LOAD else None
    own = tuple(f"{name}{link + 1}" for name in LINK_PARAMETERS)
    names = dict(zip(own, ("mass", *_MOMENT, *_INERTIA), strict=True))
    parameters = {names[name]: value for name, value in entry.parameters.items() if name in names}
    intervals = {names[name]: value for name, value in entry.intervals.items() if name in names}
    return ModelEffect("payload", (), parameters, intervals)


def _parameters(load: ModelEffect, dof: int) -> np.ndarray:
    """(10,) inertial parameters in the last link's frame."""
    numbers = CATALOGUE[load.effect].simulator_numbers(load.parameters, dof)
    assert numbers is not None
    assert numbers.body is not None
    return numbers.body[1]


def _at_least_a_point(entry: ModelEffect) -> ModelEffect:
    """The load with a negative own inertia set to zero: a point mass. A ball's inertia is that of its own mass and
    centre, not of those that it was linearised at."""
    at = {f"h{name[-1]}0" if name in _MOMENT else "m0": entry.parameters[name] for name in ("mass", *_MOMENT)}
    at = at if "m0" in entry.parameters else {}
    own = {"inertia": 0.0} if entry.parameters.get("inertia", 0.0) < 0 else {}
    return replace(entry, parameters={**entry.parameters, **at, **own})


def _errors(
    entry: ModelEffect, rotation: np.ndarray, unfelt: np.ndarray
) -> tuple[float | None, np.ndarray | None, float | None]:
    """Half the 95 % intervals of mass [kg], centre (3,) [m] turned by `turn`, infinite if `unfelt`, inertia [kg·m²]."""
    half = {name: (high - low) / 2 for name, (low, high) in entry.intervals.items()}
    if "mass" not in half:
        return None, None, None
    mass, moment = entry.parameters["mass"], np.array([entry.parameters[name] for name in _MOMENT])
    own = np.where(unfelt, _UNFELT, [half.get(name, 0.0) for name in _MOMENT])
    along = np.hypot(own / mass, moment / mass * half["mass"] / mass)
    centre = np.sqrt(rotation.T**2 @ along**2)
    return half["mass"], np.where(centre > 1.0, np.inf, centre), half.get("inertia")


def _universal_robots(load: IdentifiedLoad) -> str:
    inertia = load.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return f"set_target_payload({_number(load.mass)}, [{_vector(load.centre)}], [{_vector(inertia)}])"


def _abb(load: IdentifiedLoad) -> str:
    moments, rotation = load.principal()
    x, y, z, w = rotation.as_quat()
    parts = f"[{_vector(1e3 * load.centre)}],[{_vector([w, x, y, z])}],{_vector(moments)}"
    return f"PERS loaddata identified_load:=[{_number(load.mass)},{parts}];"


def _kuka(load: IdentifiedLoad) -> str:
    moments, rotation = load.principal()
    places = (*1e3 * load.centre, *np.degrees(rotation.as_euler("ZYX")))
    centre = ",".join(f"{key} {_number(value)}" for key, value in zip("XYZABC", places, strict=True))
    own = ",".join(f"{key} {_number(value)}" for key, value in zip("XYZ", moments, strict=True))
    return f"; 1 stands for the number of the tool\nLOAD_DATA[1]={{M {_number(load.mass)},CM {{{centre}}},J {{{own}}}}}"


def _franka(load: IdentifiedLoad) -> str:
    document = {
        "id": "identified-load",
        "name": "Identified load",
        "mass": load.mass,
        "centerOfMass": load.centre.tolist(),
        "transformation": np.eye(4).ravel().tolist(),  # column by column, from the flange
        "inertia": load.inertia.T.ravel().tolist(),  # column by column
    }
    return json.dumps(document, indent=2)


def _comau(load: IdentifiedLoad) -> str:
    inertia = load.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    elements = (f"$TOOL_INERTIA[{k}] := {_number(value)}" for k, value in enumerate(inertia, 1))
    centre = f"$TOOL_CNTR := POS({_vector(1e3 * load.centre)}, 0, 0, 0, '')"
    check = "-- Check in the controller's manual about which point its inertia counts"
    return "\n".join([check, f"$TOOL_MASS := {_number(load.mass)}", centre, *elements])


class LoadFormat(NamedTuple):
    """How a vendor writes a load: its statements, and what begins a comment (empty where the format has none)."""

    statements: Callable[[IdentifiedLoad], str]
    comment: str


#: Formats by vendor. To add one: a function from the load to the vendor's statements, and its line here.
VENDORS = {
    "ur": LoadFormat(_universal_robots, comment="#"),
    "abb": LoadFormat(_abb, comment="!"),
    "kuka": LoadFormat(_kuka, comment=";"),
    "franka": LoadFormat(_franka, comment=""),
    "comau": LoadFormat(_comau, comment="--"),
}


def load_text(load: IdentifiedLoad, vendor: str) -> tuple[str, str]:
    """The load in the format of a vendor, in any case, and remarks for stderr.

    The remarks, intervals among them, are comments at the top of the text where the vendor's format allows any.

    Raises:
        InputError: no such vendor.
    """
    if vendor.lower() not in VENDORS:
        raise InputError(f"--load {vendor}: no such vendor; there are {', '.join(VENDORS)}")
    form, remarks = VENDORS[vendor.lower()], list(_remarks(load))
    if not form.comment:
        return form.statements(load), "\n".join(remarks)
    return "\n".join([*(f"{form.comment} {line}" for line in remarks), form.statements(load)]), ""


def _remarks(load: IdentifiedLoad) -> Iterator[str]:
    yield "Identified load beyond the model's own last link."
    yield f"Frame: {load.flange} ({load.chosen}). Check that it is the controller's flange."
    if load.mass_error is None or load.centre_error is None:
        yield "Its intervals are not in the model: diagnose again with this version to get them."
    else:
        yield f"Mass: {load.mass:.4g} kg, 95 % interval ±{load.mass_error:.2g} kg."
        centre, error = (", ".join(f"{1e3 * x:.2f}" for x in row) for row in (load.centre, load.centre_error))
        yield f"Centre of mass: {centre} mm, 95 % interval ±{error} mm."
        if "inf" in error:
            yield "No torque of this arm depends on the centre along an axis of ±inf: take it from the drawing."
    if not np.any(load.inertia):
        yield "Inertia about the centre of mass: zero, as the motion showed a point mass. Prefer the drawing's value."
    elif load.inertia_error is not None:
        yield f"Inertia: of a ball about the centre of mass, 95 % interval ±{load.inertia_error:.2g} kg·m²."
        yield "Intervals hold how motions differ, not that a load of another shape has other inertias."
    else:
        yield "Inertia: about the centre of mass; its interval is not in the model."


def _number(value: float) -> str:
    """At most ten decimals, no exponent, no negative zero."""
    return np.format_float_positional(round(float(value), 10) + 0.0, trim="0")


def _vector(values: np.ndarray | list[float]) -> str:
    return ", ".join(map(_number, values))
