"""A calibrated robot for other programs: URDF, MuJoCo model, SDF, friction file and a table of parameters.

`<robot>.urdf` is the robot's URDF with the inertials of its moving links replaced, the bodies fixed to a link being
part of it, and with each joint's friction as `dynamics`: damping and friction are the line through the identified
curve. `<robot>.xml` is the same for MuJoCo, where rotors are armature; what acts on an axle that several joints turn
(motor coupling) is on a tendon. `friction.json` has what a URDF cannot say: rotor inertias, coupling, every term of
friction. `<robot>.sdf` is for Gazebo (`agent.simulators.sdf`), `parameters.csv` the table of the report, and
`foxglove-layout.json` a layout for logs of this arm.

Nothing is written that has not been read back and found to give the model's torques.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from agent.core import RejectedError, csv_text, written_whole
from agent.model.friction_terms import ODD, steady_columns
from agent.model.identified import IdentifiedModel
from agent.model.standard_parameters import check_physical, full_parameters
from agent.recording import FOXGLOVE_LAYOUT, foxglove_layout
from agent.robot import ParameterLayout, about_centre
from agent.simulators.sdf import sdf_text
from agent.simulators.urdf_elements import digits, end_of, inertial_element

_TABLE = "parameters.csv"
_STATES = 50
_TOLERANCE = 1e-9  # of the largest torque
_SPEEDS = np.linspace(0.02, 1.0, 50)  # of the highest: where the line through a friction curve is laid


def export_model(model: IdentifiedModel, folder: Path) -> tuple[Path, ...]:
    """Write URDF, MuJoCo model, SDF, friction, parameters and a Foxglove layout into a folder, replacing older ones.

    Returns their paths.

    Raises:
        RejectedError: no physical links have the model's base parameters, or what was written does not give them back.
        OSError: the folder cannot be written.
    """
    standard = full_parameters(model)
    check_physical(model.robot, standard)
    lines = _friction_lines(model)
    texts = {
        folder / f"{model.robot.name}.urdf": urdf_text(model, standard, lines),
        folder / f"{model.robot.name}.xml": mujoco_text(model, standard, lines),
        folder / "friction.json": json.dumps(friction_data(model, standard, lines), indent=1, allow_nan=False),
        folder / f"{model.robot.name}.sdf": sdf_text(model, standard, lines),
        folder / _TABLE: csv_text(model.rows()),
        folder / FOXGLOVE_LAYOUT: foxglove_layout(model.robot.joint_names),
    }
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        parts = [stack.enter_context(written_whole(path)) for path in texts]
        for part, text in zip(parts, texts.values(), strict=True):
            part.write_text(text, encoding="utf-8")
        urdf, mujoco, friction, *_ = parts
        _read_back(model, urdf, mujoco, friction)
    return tuple(texts)


def export_table(model: IdentifiedModel, folder: Path) -> tuple[Path, ...]:
    """Write the table of parameters alone, which every model has; returns its path, as one of several.

    Raises:
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with written_whole(folder / _TABLE) as part:
        part.write_text(csv_text(model.rows()), encoding="utf-8")
    return (folder / _TABLE,)


def urdf_text(model: IdentifiedModel, standard: np.ndarray, lines: np.ndarray) -> str:
    """The robot's URDF with inertials (11 n,) and friction `lines` (n, 2): damping and friction of every axle.

    Joints that the description leaves out are held, hence fixed. Gravity is there for MuJoCo, which would take 9.81.
    """
    robot = model.robot
    layout = ParameterLayout.of(robot)
    root = ElementTree.fromstring(robot.urdf)
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    children: dict[str | None, list[str]] = {}
    for name, joint in joints.items():
        if name not in robot.joint_names:
            joint.set("type", "fixed")
            children.setdefault(end_of(joint, "parent"), []).append(end_of(joint, "child"))
    links = {link.get("name"): link for link in root.findall("link")}
    own = np.abs(np.diag(robot.coupling))
    for k, name in enumerate(robot.joint_names):
        moved = end_of(joints[name], "child")
        for fixed in _descendants(moved, children):
            for old in links[fixed].findall("inertial"):
                links[fixed].remove(old)
        block = standard[layout.link(k)]
        links[moved].insert(0, inertial_element(block[0], block[1:4] / block[0], about_centre(block)))
        for old in joints[name].findall("dynamics"):
            joints[name].remove(old)
        damping, friction = lines[k] * (own[k] ** 2, own[k])
        SubElement(joints[name], "dynamics", damping=digits(damping), friction=digits(friction))
    extension = root.find("mujoco")
    extension = SubElement(root, "mujoco") if extension is None else extension
    option = extension.find("option")
    option = SubElement(extension, "option") if option is None else option
    option.set("gravity", digits(*robot.gravity))
    return _document(root)


def mujoco_text(model: IdentifiedModel, standard: np.ndarray, lines: np.ndarray) -> str:
    """The same as a MuJoCo model, without geometry."""
    from agent.robot import joint_axes

    robot, dynamics = model.robot, model.rigid.dynamics
    layout = ParameterLayout.of(robot)
    root = Element("mujoco", model=robot.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", gravity=digits(*robot.gravity))
    body = SubElement(root, "worldbody")
    joints = {joint.get("name"): joint for joint in ElementTree.fromstring(robot.urdf).findall("joint")}
    before, zero = np.eye(4), np.zeros((1, robot.dof))
    armature = robot.gear_ratios**2 * standard[layout.rotors]
    tendons = []
    for k, (joint, axis) in enumerate(zip(robot.joints, joint_axes(robot), strict=True)):
        link = end_of(joints[joint.name], "child")
        frame = dynamics.link_poses(zero, link)[0]
        body = SubElement(body, "body", {"name": link, **_placement(np.linalg.solve(before, frame))})
        before = frame
        block = standard[layout.link(k)]
        inertia = about_centre(block)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        SubElement(
            body, "inertial", pos=digits(*(block[1:4] / block[0])), mass=digits(block[0]), fullinertia=digits(*inertia)
        )
        element = SubElement(body, "joint", name=joint.name, type="slide" if joint.prismatic else "hinge")
        element.set("axis", digits(*axis))
        if np.isfinite([joint.lower, joint.upper]).all():
            element.set("range", digits(joint.lower, joint.upper))
        row = robot.coupling[k]
        if np.count_nonzero(row) == 1 and row[k] != 0:
            size = abs(row[k])
            element.attrib.update(_axle(armature[k] * size**2, lines[k, 0] * size**2, lines[k, 1] * size))
        else:
            tendons.append((f"axle_{k + 1}", row, _axle(armature[k], *lines[k])))
    tip = np.linalg.solve(before, dynamics.tip_pose(zero)[0])
    SubElement(body, "site", {"name": robot.tip_frame, **_placement(tip)})
    if tendons:
        group = SubElement(root, "tendon")
        for name, row, acting in tendons:
            tendon = SubElement(group, "fixed", {"name": name, **acting})
            for axle in np.flatnonzero(row):
                SubElement(tendon, "joint", joint=robot.joint_names[axle], coef=digits(row[axle]))
    return _document(root)


def friction_data(model: IdentifiedModel, standard: np.ndarray, lines: np.ndarray) -> dict[str, Any]:
    """Content of friction.json: what drives the joints."""
    robot = model.robot
    layout = ParameterLayout.of(robot)
    rotors = standard[layout.rotors]
    values = model.friction_values
    reflected = robot.coupling.T @ np.diag(robot.gear_ratios**2 * rotors) @ robot.coupling
    axles = []
    for k, joint in enumerate(robot.joints):
        terms = [
            {
                "form": term.form,
                "value": float(value),
                "unit": term.unit(joint.prismatic),
                "reversal": None if term.reversal is None else asdict(term.reversal),
                "fading": term.fading,
            }
            for term, value in zip(model.terms, values, strict=True)
            if term.axle == k
        ]
        axles.append(
            {
                "name": joint.name,
                "gear_ratio": joint.gear_ratio,
                "rotor_inertia": float(rotors[k]),
                "armature": float(joint.gear_ratio**2 * rotors[k]),
                "damping": float(lines[k, 0]),
                "friction": float(lines[k, 1]),
                "terms": terms,
            }
        )
    return {
        "schema": "friction/1",
        "robot": robot.name,
        "gravity": list(robot.gravity),
        "axles": axles,
        "motor_coupling": robot.coupling.tolist(),
        "reflected_inertia": reflected.tolist(),
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
        yield "In the URDF the friction of a coupled axle is that of its own joint, for want of a way to say more."
    if model.effects:
        yield f"Not in these files: {', '.join(effect.effect for effect in model.effects)}."


def _friction_lines(model: IdentifiedModel) -> np.ndarray:
    """(n, 2) damping and friction, neither negative, nearest to what changes sign with the speed of every axle."""
    from scipy.optimize import nnls

    robot = model.robot
    values = model.friction_values
    highest = np.abs(robot.coupling) @ robot.max_velocity
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


def _read_back(model: IdentifiedModel, urdf: Path, mujoco: Path, friction: Path) -> None:
    """Raise RejectedError unless the files on disk give the torques of the model's links and rotors."""
    from agent.robot import Dynamics, rotor_mass_matrix

    robot = model.robot
    rng = np.random.default_rng(0)
    lower, upper = (np.clip(limit, -np.pi, np.pi) for limit in robot.position_limits)
    q = rng.uniform(lower, upper, (_STATES, robot.dof))
    qd = rng.uniform(-1, 1, q.shape) * robot.max_velocity
    qdd = rng.uniform(-1, 1, q.shape) * robot.max_acceleration
    expected = model.rigid.torque(q, qd, qdd, model.base_values)

    read = Dynamics(replace(robot, urdf=urdf.read_text(encoding="utf-8")))
    axles = json.loads(friction.read_text(encoding="utf-8"))["axles"]
    rotors = rotor_mass_matrix(robot, np.array([axle["rotor_inertia"] for axle in axles]))
    torque = read.inverse_dynamics(q, qd, qdd) + qdd @ rotors
    difference = float(np.max(np.abs(torque - expected)))
    if not difference <= _TOLERANCE * float(np.max(np.abs(expected))):
        raise RejectedError(
            f"{urdf.parent}: nothing was exported: the URDF as written gives torques that differ by {difference:.3g} "
            "N·m from the model's"
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
