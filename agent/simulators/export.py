"""A calibrated robot for other programs: URDF, MuJoCo model, SDF, friction file and a table of parameters.

`<robot>.urdf` is the robot's URDF with the inertials of its moving links replaced, the bodies fixed to a link being
part of it, and with each joint's friction as `dynamics`: damping and friction are the line through the identified
curve. `<robot>.xml` is the same for MuJoCo, where rotors are armature; what acts on an axle that several joints turn
(motor coupling) is on a tendon. `friction.json` has what a URDF cannot say: rotor inertias, coupling, every term of
friction. `<robot>.sdf` is for Gazebo, `parameters.csv` the report's table, `foxglove-layout.json` a layout for logs.

Nothing is written that has not been read back and found to give the model's torques.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from scipy.optimize import nnls

from agent.core import RejectedError, csv_text, write_atomically, written_whole
from agent.model import ODD, IdentifiedModel, check_physical, full_parameters, steady_columns
from agent.recording import FOXGLOVE_LAYOUT, foxglove_layout
from agent.robot import Dynamics, Joint, ParameterLayout, about_centre, joint_axes, rotor_mass_matrix
from agent.runs import make_folder
from agent.simulators.effect_numbers import NumbersOfModel, in_numbers, left_out, usual_motion
from agent.simulators.urdf import child_of, digits, end_of, mjcf_inertial, moved_links, rpy_of, set_inertial

_TABLE = "parameters.csv"
_STATES = 50
_NO_LIMIT = "1e9"  # a limit of a URDF has to have a number
_TOLERANCE, _LEFT_OUT = 1e-9, 1e-4  # of the largest torque: round-off; base parameters, where pi has few digits
_SPEEDS = np.linspace(0.02, 1.0, 50)  # of the fit's highest: where the line through a friction curve is laid


def export_model(
    model: IdentifiedModel, folder: Path, say: Callable[[str], None] = lambda text: None
) -> tuple[Path, ...]:
    """Write URDF, MuJoCo model, SDF, friction, parameters and a Foxglove layout into a folder; returns their paths.

    Effects that are numbers of these files are in them, a load on the last link among others. `say` is told what the
    files do not have, and its torque.

    Args:
        model: to write.
        folder: for the files.
        say: told what the files do not have, and its torque.

    Raises:
        RejectedError: no physical links have the model's base parameters, or what was written does not give them back.
        AgentError, OSError: the folder cannot be written.
    """
    table, numbers = csv_text(model.rows()), in_numbers(model)
    model = numbers.model
    standard = full_parameters(model)
    check_physical(model.robot, standard)
    lines, rotors = friction_lines(model), standard[ParameterLayout.of(model.robot).rotors]
    links = _links(model, standard, lines)
    urdf_of_arm, mjcf_of_arm = body_texts(numbers, standard, lines)
    texts = {
        folder / f"{model.robot.name}.urdf": urdf_of_arm,
        folder / f"{model.robot.name}.xml": mjcf_of_arm,
        folder / "friction.json": json.dumps(friction_data(model, rotors, lines), indent=1, allow_nan=False),
        folder / f"{model.robot.name}.sdf": sdf_text(numbers, links),
        folder / _TABLE: table,
        folder / FOXGLOVE_LAYOUT: foxglove_layout(model.robot.joint_names),
    }
    make_folder(folder, "the export")
    with ExitStack() as stack:
        parts = [stack.enter_context(written_whole(path)) for path in texts]
        for part, text in zip(parts, texts.values(), strict=True):
            part.write_text(text, encoding="utf-8")
        urdf, mujoco, friction, *_ = parts
        _read_back(model, standard, urdf, mujoco, friction)
    for text in _missing(numbers, rotors, lines):
        say(f"{folder}: {text}")
    return tuple(texts)


def _missing(numbers: NumbersOfModel, rotors: np.ndarray, lines: np.ndarray) -> Iterator[str]:
    """What which of the files lacks."""
    model = numbers.model
    if numbers.note:
        yield numbers.note
    if missing := list(left_out(model, lines)):
        yield f"the files do not have: {'; '.join(missing)}"
    yield from assumed(model)
    turning = np.abs(usual_motion(model.robot)[3] @ rotor_mass_matrix(model.robot, rotors)).max(axis=0)
    worst = int(np.argmax(turning))
    if turning[worst] > 0:
        unit = model.robot.joints[worst].torque_unit
        yield (
            f"URDF and SDF have no rotor inertia (up to {turning[worst]:.3g} {unit} on "
            f"{model.robot.joint_names[worst]}): take armature from friction.json"
        )
    if np.any(model.robot.coupling - np.diag(np.diag(model.robot.coupling))):
        yield "URDF and SDF have no coupled axles: each joint has the friction of its own axle"
    if numbers.springs:
        names = ", ".join(name for entry in numbers.springs for name in entry.joints)
        yield f"the URDF has no springs: that of {names} is in the MuJoCo model and the SDF only"
    if np.linalg.norm(np.cross(model.robot.gravity, (0.0, 0.0, 1.0))) > 0:
        gravity = ", ".join(f"{value:.6g}" for value in model.robot.gravity)
        yield f"gravity is ({gravity}) m/s²: URDF and SDF leave it to the simulator's world, so set it there"


def assumed(model: IdentifiedModel) -> Iterator[str]:
    """What no log of the fit says."""
    axles = {term.axle for k, term in enumerate(model.terms) if model.unmoved[len(model.independent) + k]}
    if names := ", ".join(model.robot.joint_names[axle] for axle in sorted(axles)):
        yield f"{names} stood still in the logs: friction and rotor inertia there are not measured, set your own"


def export_table(model: IdentifiedModel, folder: Path) -> tuple[Path, ...]:
    """Write only the table of parameters, which every model has; returns its path in a tuple.

    Raises:
        AgentError: the folder cannot be written.
    """
    make_folder(folder, "the export")
    return (write_atomically(folder / _TABLE, csv_text(model.rows())),)


@dataclass(frozen=True, eq=False)
class _Link:
    """A moving link: name, inertia (10,), pose (4, 4) at q = 0, and the axis (3,) of its joint in its frame.

    `damping` and `friction` are those of its axle at the joint; of a coupled one they are that of its own joint.
    """

    joint: Joint
    name: str
    block: np.ndarray
    pose: np.ndarray
    axis: np.ndarray
    damping: float
    friction: float

    @property
    def centre(self) -> np.ndarray:
        """(3,) centre of mass."""
        return np.asarray(self.block[1:4] / self.block[0])


def _links(model: IdentifiedModel, standard: np.ndarray, lines: np.ndarray) -> list[_Link]:
    """The moving links from base to tip, for standard parameters (11 n,) and damping and friction `lines` (n, 2)."""
    robot = model.robot
    blocks, own = ParameterLayout.of(robot).blocks(standard), np.abs(np.diag(robot.coupling))
    links = []
    for k, (joint, name, axis) in enumerate(zip(robot.joints, moved_links(robot), joint_axes(robot), strict=True)):
        pose = model.rigid.dynamics.link_poses(np.zeros((1, robot.dof)), name)[0]
        links.append(_Link(joint, name, blocks[k], pose, axis, *map(float, lines[k] * (own[k] ** 2, own[k]))))
    return links


def body_texts(numbers: NumbersOfModel, standard: np.ndarray, lines: np.ndarray) -> tuple[str, str]:
    """URDF and MJCF of the bodies, with the friction of `lines` (n, 2), for standard parameters (11 n,)."""
    links, rotors = _links(numbers.model, standard, lines), standard[ParameterLayout.of(numbers.model.robot).rotors]
    armature = numbers.model.robot.gear_ratios**2 * rotors
    return urdf_text(numbers.model, links), mujoco_text(numbers, links, armature, lines)


def urdf_text(model: IdentifiedModel, links: Iterable[_Link]) -> str:
    """The robot's URDF with the identified inertias and friction.

    Joints that the description leaves out are held, hence fixed. Gravity is there for MuJoCo, which would take 9.81.
    """
    robot = model.robot
    root = ElementTree.fromstring(robot.urdf)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    children: dict[str | None, list[str]] = {}
    for name, joint in joints.items():
        if name not in robot.joint_names:
            joint.set("type", "fixed")
            children.setdefault(end_of(joint, "parent"), []).append(end_of(joint, "child"))
    elements = {link.get("name"): link for link in root.findall("link")}
    for link in links:
        for fixed in _descendants(link.name, children):
            for old in elements[fixed].findall("inertial"):
                elements[fixed].remove(old)
        set_inertial(elements[link.name], link.block)
        for old in joints[link.joint.name].findall("dynamics"):
            joints[link.joint.name].remove(old)
        _limit(joints[link.joint.name], link.joint)
        dynamics = {"damping": digits(link.damping), "friction": digits(link.friction)}
        SubElement(joints[link.joint.name], "dynamics", dynamics)
    child_of(child_of(root, "mujoco"), "option").set("gravity", digits(*robot.gravity))
    return _document(root)


def _limit(element: Element, joint: Joint) -> None:
    """Give a joint of a URDF its range, where its file was none or had no limits."""
    if not np.isfinite([joint.lower, joint.upper]).all() or element.get("type") == "revolute":
        return
    element.set("type", "prismatic" if joint.prismatic else "revolute")
    limit = child_of(element, "limit")
    effort = _NO_LIMIT if joint.max_torque is None else digits(joint.max_torque)
    limit.attrib.update({"effort": effort, "velocity": _NO_LIMIT, **limit.attrib})
    limit.attrib.update(lower=digits(joint.lower), upper=digits(joint.upper))


def mujoco_text(numbers: NumbersOfModel, links: Iterable[_Link], armature: np.ndarray, lines: np.ndarray) -> str:
    """A MuJoCo model without geometry; `armature` (n,) and `lines` (n, 2) are those of the axles."""
    model, robot = numbers.model, numbers.model.robot
    root = Element("mujoco", model=robot.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", gravity=digits(*robot.gravity))
    body, before, tendons = SubElement(root, "worldbody"), np.eye(4), Element("tendon")
    for k, link in enumerate(links):
        body = SubElement(body, "body", {"name": link.name, **_placement(np.linalg.solve(before, link.pose))})
        before = link.pose
        SubElement(body, "inertial", mjcf_inertial(link.block))
        kind = "slide" if link.joint.prismatic else "hinge"
        element = SubElement(body, "joint", name=link.joint.name, type=kind, axis=digits(*link.axis))
        if np.isfinite([link.joint.lower, link.joint.upper]).all():
            element.set("range", digits(link.joint.lower, link.joint.upper))
        if numbers.stiffness[k]:
            element.set("stiffness", digits(numbers.stiffness[k]))
            element.set("springref", digits(numbers.rest[k]))
        row = robot.coupling[k]
        if np.count_nonzero(row) == 1 and row[k] != 0:
            element.attrib.update(_axle(armature[k] * row[k] ** 2, link.damping, link.friction))
        else:
            tendon = SubElement(tendons, "fixed", {"name": f"axle_{k + 1}", **_axle(armature[k], *lines[k])})
            for axle in np.flatnonzero(row):
                SubElement(tendon, "joint", joint=robot.joint_names[axle], coef=digits(row[axle]))
    tip = np.linalg.solve(before, model.rigid.dynamics.tip_pose(np.zeros((1, robot.dof)))[0])
    SubElement(body, "site", {"name": robot.tip_frame, **_placement(tip)})
    if len(tendons):
        root.append(tendons)
    return _document(root)


def sdf_text(numbers: NumbersOfModel, links: Iterable[_Link]) -> str:
    """An SDF model of the moving links; the first is attached to `world`."""
    root = Element("sdf", version="1.9")
    body, parent = SubElement(root, "model", name=numbers.model.robot.name), "world"

    def put(element: Element, tag: str, *numbers: float) -> None:
        SubElement(element, tag).text = digits(*numbers)

    for k, link in enumerate(links):
        element = SubElement(body, "link", name=link.name)
        put(element, "pose", *link.pose[:3, 3], *rpy_of(link.pose))
        inertial = SubElement(element, "inertial")
        put(inertial, "pose", *link.centre, 0.0, 0.0, 0.0)
        put(inertial, "mass", link.block[0])
        inertia, tensor = about_centre(link.block), SubElement(inertial, "inertia")
        for i in range(3):
            for j in range(i, 3):
                put(tensor, f"i{'xyz'[i]}{'xyz'[j]}", inertia[i, j])
        joint = SubElement(
            body, "joint", name=link.joint.name, type="prismatic" if link.joint.prismatic else "revolute"
        )
        SubElement(joint, "parent").text, SubElement(joint, "child").text = parent, link.name
        axis = SubElement(joint, "axis")
        put(axis, "xyz", *link.axis)
        limit, dynamics = SubElement(axis, "limit"), SubElement(axis, "dynamics")
        for end, bound in (("lower", link.joint.lower), ("upper", link.joint.upper)):
            if np.isfinite(bound):
                put(limit, end, bound)
        put(limit, "velocity", link.joint.max_velocity)
        put(dynamics, "damping", link.damping)
        put(dynamics, "friction", link.friction)
        if numbers.stiffness[k]:
            put(dynamics, "spring_reference", numbers.rest[k])
            put(dynamics, "spring_stiffness", numbers.stiffness[k])
        parent = link.name
    return _document(root)


def friction_data(model: IdentifiedModel, rotors: np.ndarray, lines: np.ndarray) -> dict[str, Any]:
    """Content of friction.json: rotors, coupling, every friction term, and effects that no file of these has."""
    robot = model.robot
    terms: list[list[dict[str, Any]]] = [[] for _ in robot.joints]
    unmoved = model.unmoved[len(model.independent) :]
    for term, value, still in zip(model.terms, model.friction_values, unmoved, strict=True):
        terms[term.axle].append(
            {
                "form": term.form,
                "value": None if still else float(value),
                "unit": term.unit(robot.joints[term.axle].prismatic),
                "reversal": None if term.reversal is None else asdict(term.reversal),
                "fading": term.fading,
            }
        )
    axles = [
        {
            "name": joint.name,
            "gear_ratio": joint.gear_ratio,
            "rotor_inertia": float(rotors[k]),
            "armature": float(joint.gear_ratio**2 * rotors[k]),
            "damping": float(lines[k, 0]),
            "friction": float(lines[k, 1]),
            "terms": terms[k],
        }
        for k, joint in enumerate(robot.joints)
    ]
    return {
        "schema": "friction/1",
        "robot": robot.name,
        "gravity": list(robot.gravity),
        "axles": axles,
        "motor_coupling": robot.coupling.tolist(),
        "reflected_inertia": (robot.coupling.T @ np.diag(robot.gear_ratios**2 * rotors) @ robot.coupling).tolist(),
        "effects": [entry.to_dict() for entry in model.effects],
        "notes": list(_notes(model)),
    }


def _notes(model: IdentifiedModel) -> Iterable[str]:
    yield (
        "SI units. Axles turn at w = C qd with C = motor_coupling; a torque f on them is C^T f on the joints. "
        "rotor_inertia is on the motor side, armature on the axle, reflected_inertia = C^T diag(armature) C on the "
        "joints, to be added to the mass matrix of the URDF's links."
    )
    yield (
        "terms are the identified friction of an axle (s: direction of sliding): coulomb s, viscous w, quadratic w|w|, "
        "offset 1, viscous_asymmetry |w|, stribeck s exp(-|w|/fading), load s |load|; damping w + friction s is the "
        "line through those that change sign with w, up to the highest speed."
    )
    if np.any(model.robot.coupling - np.diag(np.diag(model.robot.coupling))):
        yield "A URDF cannot describe coupled friction: the friction of a coupled axle is that of its own joint."
    yield from assumed(model)


def friction_lines(model: IdentifiedModel) -> np.ndarray:
    """(n, 2) damping and friction, neither negative, nearest to what changes sign with the speed of every axle."""
    robot, values = model.robot, model.friction_values
    highest = np.abs(robot.coupling) @ model.fastest
    lines = np.zeros((robot.dof, 2))
    for k in range(robot.dof):
        speed = _SPEEDS * highest[k]
        own = [(t, v) for t, v in zip(model.terms, values, strict=True) if t.axle == k and t.form in ODD]
        columns = steady_columns([term for term, _ in own], speed, sharp=True)
        curve = np.sum(columns * [value for _, value in own], axis=1)
        forms = {term.form: value for term, value in own}
        if set(forms) <= {"coulomb", "viscous"} and min(forms.values(), default=0.0) >= 0:
            lines[k] = forms.get("viscous", 0.0), forms.get("coulomb", 0.0)
        else:
            lines[k] = nnls(np.stack([_SPEEDS, np.ones_like(speed)], axis=1), curve)[0] / (highest[k], 1.0)
    return lines


def _read_back(model: IdentifiedModel, standard: np.ndarray, urdf: Path, mujoco: Path, friction: Path) -> None:
    """Raise RejectedError unless the files on disk give the torques of the model's links and rotors."""
    robot, layout = model.robot, ParameterLayout.of(model.robot)
    rng = np.random.default_rng(0)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    q = rng.uniform(lower, upper, (_STATES, robot.dof))
    qd = rng.uniform(-1, 1, q.shape) * robot.max_velocity
    qdd = rng.uniform(-1, 1, q.shape) * robot.max_acceleration
    expected = model.rigid.dynamics.regressor(q, qd, qdd) @ standard[layout.links]
    expected += qdd @ rotor_mass_matrix(robot, standard[layout.rotors])
    left_out = np.max(np.abs(model.rigid.torque(q, qd, qdd, model.base_values) - expected))
    read = Dynamics(replace(robot, urdf=urdf.read_text(encoding="utf-8")))
    axles = json.loads(friction.read_text(encoding="utf-8"))["axles"]
    rotors = rotor_mass_matrix(robot, np.array([axle["rotor_inertia"] for axle in axles]))
    torque = read.inverse_dynamics(q, qd, qdd) + qdd @ rotors
    difference, most = np.max(np.abs(torque - expected)), np.max(np.abs(expected))
    if not (difference <= _TOLERANCE * most and left_out <= _LEFT_OUT * most):
        raise RejectedError(
            f"{urdf.parent}: nothing was exported: the URDF as written gives torques that differ by "
            f"{max(difference, left_out):.3g} N·m from the model's"
        )
    ElementTree.parse(mujoco)


def _placement(pose: np.ndarray) -> dict[str, str]:
    return {"pos": digits(*pose[:3, 3]), "xyaxes": digits(*pose[:3, 0], *pose[:3, 1])}


def _axle(armature: float, damping: float, friction: float) -> dict[str, str]:
    return {"armature": digits(armature), "damping": digits(damping), "frictionloss": digits(friction)}


def _descendants(link: str, children: dict[str | None, list[str]]) -> Iterable[str]:
    yield link
    for child in children.get(link, []):
        yield from _descendants(child, children)


def _document(root: Element) -> str:
    ElementTree.indent(root)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
