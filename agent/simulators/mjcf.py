"""An MJCF as a simulator, read through MuJoCo's own package: compiler, defaults, includes and units are its job."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from agent.core import InputError, needed
from agent.simulators.arm import SimulatedArm, described, model_of
from agent.simulators.bodies import CarryingBody, parameters
from agent.simulators.joints import leaving_out, listed
from agent.simulators.servos import position_servos
from agent.simulators.urdf_elements import digits, inertial_element, rpy_of

#: What the compilation of one file may take: seconds of processor time, bytes of memory.
_SECONDS, _MEMORY = 10, 4 << 30
_COMPILE = """
import resource, sys
path, place, seconds, memory = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
import mujoco
try:
    mujoco.mj_saveModel(mujoco.MjModel.from_xml_path(path), place)
except Exception as error:  # MuJoCo raises ValueError, and others from its plugins
    print(error)
"""
_BASE = "base"
_TIP = "tip"


def mujoco_package() -> Any:
    """The `mujoco` package.

    Raises:
        InputError: it is not installed.
    """
    return needed("mujoco", "an MJCF", "mujoco")


def compiled(path: Path) -> Any:
    """The compiled model (MjModel) of a file.

    Raises:
        InputError: MuJoCo does not accept it; its own words are passed on.
    """
    mujoco = mujoco_package()
    with tempfile.TemporaryDirectory(prefix="calibration-agent-") as folder:
        place = Path(folder) / "arm.mjb"
        said = _compile_apart(path, place)
        if not place.is_file():
            missing = (
                ". Files that it includes, meshes too, belong where it names them" if "opening file" in said else ""
            )
            raise InputError(f"{path}: MuJoCo does not accept it: {said}{missing}")
        return mujoco.MjModel.from_binary_path(str(place))


def _compile_apart(path: Path, place: Path) -> str:
    """Compile in a process of its own, which leaves the model at `place`; returns what MuJoCo said.

    A few lines may ask for a hundred million bodies, and nothing ends MuJoCo on the way: the process has a limit of
    processor time and memory, and is ended with this one.
    """
    command = [sys.executable, "-c", _COMPILE, str(path.resolve()), str(place), str(_SECONDS), str(_MEMORY)]
    with subprocess.Popen(command, cwd=place.parent, stdout=-1, stderr=-3, stdin=-3) as process:
        try:
            told, _ = process.communicate(timeout=10 * _SECONDS)
        except subprocess.TimeoutExpired:
            told = b""
        finally:
            process.kill()
    told = b" ".join(told.split())
    too_much = f"it takes more than {_SECONDS} s of processor time, or {_MEMORY >> 30} GiB of memory, to compile"
    return told.decode(errors="replace") or too_much


def read_mjcf(path: Path, match: Callable[[Sequence[str]], Mapping[str, str]]) -> SimulatedArm:
    """The arm of an MJCF; joints that `match` leaves out are held where the file starts them.

    Raises:
        InputError: not accepted by MuJoCo, closed loops, tendons or polynomials that act on the arm, or no one chain.
    """
    mujoco = mujoco_package()
    model = compiled(path)
    hinge, slide = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
    names = {j: model.joint(j).name for j in range(model.njnt) if model.jnt_type[j] in (hinge, slide)}
    used = match([name for name in names.values() if name])
    chosen = [j for j, name in names.items() if name in used]  # MuJoCo orders joints from base to tip
    link_of = _links(path, model, chosen, names, used)
    _refuse(path, mujoco, model, chosen, link_of, used)
    notes = tuple(_notes(model, chosen, link_of))
    dof, at = model.jnt_dofadr[chosen], model.jnt_qposadr[chosen]
    limited = model.jnt_limited[chosen].astype(bool)
    urdf = _urdf(mujoco, model, chosen, link_of, [used[names[j]] for j in chosen], slide)
    x, y, z = (float(value) for value in model.opt.gravity)
    arm = SimulatedArm(
        path=path,
        name=_model_name(path),
        urdf=ElementTree.tostring(urdf, encoding="unicode"),
        tip_frame=_TIP,
        gravity=(x, y, z),
        joint_names=tuple(used[names[j]] for j in chosen),
        file_joints=tuple(names[j] for j in chosen),
        prismatic=tuple(bool(model.jnt_type[j] == slide) for j in chosen),
        lower=np.where(limited, model.jnt_range[chosen, 0], -np.inf),
        upper=np.where(limited, model.jnt_range[chosen, 1], np.inf),
        max_velocity=np.full(len(chosen), np.nan),
        armature=np.array(model.dof_armature[dof]),
        damping=np.array(model.dof_damping[dof]),
        frictionloss=np.array(model.dof_frictionloss[dof]),
        stiffness=np.array(model.jnt_stiffness[chosen]),
        rest=np.array(model.qpos_spring[at]),
        carrying=tuple(_carrying(mujoco, model, chosen, link_of)),
        notes=notes,
        servos=position_servos(mujoco, model, chosen),
    )
    _check(mujoco, model, arm, chosen)
    return arm


def longest_branch(path: Path) -> list[str]:
    """Joints from base to tip on the way that has most of them, without those that an equality ties together.

    Raises:
        InputError: MuJoCo does not accept the file.
    """
    mujoco, model = mujoco_package(), compiled(path)
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)}
    tied = {
        int(one)
        for k in np.flatnonzero(model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT))
        for one in (model.eq_obj1id[k], model.eq_obj2id[k])
    }
    longest: list[str] = []
    for body in range(1, model.nbody):
        chain: list[str] = []
        while body > 0:
            own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            chain = [model.joint(j).name for j in own if int(model.jnt_type[j]) in kinds and j not in tied] + chain
            body = int(model.body_parentid[body])
        longest = max(longest, [name for name in chain if name], key=len)
    return longest


def _links(path: Path, model: Any, chosen: list[int], names: Mapping[int, str], used: Mapping[str, str]) -> np.ndarray:
    """(bodies,) which link each body is part of, from 0 for the base; k is moved by the k-th chosen joint."""
    link_of = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):
        link = link_of[model.body_parentid[body]]
        own = [j for j in chosen if model.jnt_bodyid[j] == body]
        if len(own) > 1:
            raise InputError(
                f"{path}: {listed([names[j] for j in own])} move one body ({model.body(body).name!r}), and every joint "
                f"needs a link of its own: give each a body, or {leaving_out(used, [names[j] for j in own])}"
            )
        for number, j in enumerate(chosen, 1):
            if j in own:
                if link != number - 1:
                    raise InputError(
                        f"{path}: {names[j]} is on another branch than {names[chosen[number - 2]]}. One serial arm is "
                        f"compared at a time, without other branches: {leaving_out(used, [names[j]])}"
                    )
                link = number
        link_of[body] = link
    return link_of


def _refuse(
    path: Path, mujoco: Any, model: Any, chosen: list[int], link_of: np.ndarray, used: Mapping[str, str]
) -> None:
    """Raise InputError for what acts on the arm and has no form here."""
    free = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
    body = int(model.jnt_bodyid[chosen[0]])
    while body > 0:
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            if model.jnt_type[j] in free:
                raise InputError(
                    f"{path}: the arm's base floats (joint of body {model.body(body).name!r}): "
                    "delete that joint, so that the base stands"
                )
        body = int(model.body_parentid[body])
    loops = {int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)}
    sites = int(mujoco.mjtObj.mjOBJ_SITE)
    for k in np.flatnonzero(model.eq_active0).tolist():
        one, two = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if model.eq_type[k] in loops:
            ends = model.site_bodyid[[one, two]] if model.eq_objtype[k] == sites else [one, two]
            links = link_of[list(ends)]
            if links[0] != links[1] and links.max() > 0:
                raise InputError(
                    f"{path}: the equality {model.eq(k).name or k!r} closes a loop between "
                    f"{model.body(ends[0]).name!r} and {model.body(ends[1]).name!r}: a serial arm is compared; "
                    "make an open chain of it, or delete it"
                )
        elif model.eq_type[k] == int(mujoco.mjtEq.mjEQ_JOINT) and one in chosen:
            other = "a constant" if two < 0 else repr(model.joint(two).name)
            raise InputError(
                f"{path}: joint {model.joint(one).name!r} follows {other} (equality), and joints that all move on "
                f"their own are compared: {leaving_out(used, [model.joint(one).name])}"
            )
    for k in range(model.ntendon):
        parts = range(model.tendon_adr[k], model.tendon_adr[k] + model.tendon_num[k])
        fixed = [int(model.wrap_objid[w]) for w in parts if model.wrap_type[w] == int(mujoco.mjtWrap.mjWRAP_JOINT)]
        acts = any(
            float(getattr(model, f"tendon_{key}", np.zeros(model.ntendon))[k]) != 0
            for key in ("stiffness", "damping", "frictionloss", "armature")
        )
        if acts and (not fixed or set(fixed) & set(chosen)):
            raise InputError(
                f"{path}: tendon {model.tendon(k).name or k!r} has stiffness, damping, friction or armature of its own "
                "on the arm, which is not read: give them to joints, or delete the tendon"
            )


def _notes(model: Any, chosen: list[int], link_of: np.ndarray) -> Iterator[str]:
    moved = [j for j in range(model.njnt) if j not in chosen and link_of[model.jnt_bodyid[j]] > 0]
    if moved:
        yield (
            f"{', '.join(model.joint(j).name or '(no name)' for j in moved)} held where the file starts it: "
            "not among the joints compared"
        )
    apart = [j for j in range(model.njnt) if j not in chosen and link_of[model.jnt_bodyid[j]] == 0]
    if apart:
        yield f"{', '.join(model.joint(j).name or '(no name)' for j in apart)} ignored: no part of the arm"
    if np.any(model.body_gravcomp[link_of > 0]):
        yield "gravcomp is ignored: a robot's measured torque carries its weight"
    if model.opt.density or model.opt.viscosity:
        yield "the medium (density, viscosity) is ignored"


def _urdf(mujoco: Any, model: Any, chosen: list[int], link_of: np.ndarray, names: Sequence[str], slide: int) -> Element:
    """The chain at q = 0, all links' frames parallel to the world's, bodies lumped into the link that carries them."""
    data = _at(mujoco, model, chosen, np.zeros(len(chosen)))
    anchors = np.vstack([np.zeros(3), data.xanchor[chosen]])
    root = Element("robot", name="arm")
    links = [_BASE, *_link_names(model, chosen)]
    for k, link in enumerate(links):
        element = SubElement(root, "link", name=link)
        bodies = [b for b in range(1, model.nbody) if k > 0 and link_of[b] == k and model.body_mass[b] > 0]
        if bodies:
            mass, centre, inertia = _lumped(model, data, bodies)
            element.append(inertial_element(mass, centre - anchors[k], inertia))
    for k, (j, name) in enumerate(zip(chosen, names, strict=True), 1):
        kind = "prismatic" if model.jnt_type[j] == slide else "continuous"
        joint = _joint(root, name, kind, links[k - 1], links[k], anchors[k] - anchors[k - 1], np.zeros(3))
        SubElement(joint, "axis", xyz=digits(*data.xaxis[j]))
        if kind == "prismatic":
            SubElement(joint, "limit", lower="-1e9", upper="1e9", effort="1e9", velocity="1e9")
    SubElement(root, "link", name=_TIP)
    last = int(model.jnt_bodyid[chosen[-1]])
    _joint(
        root, "to_tip", "fixed", links[-1], _TIP, data.xpos[last] - anchors[-1], rpy_of(data.xmat[last].reshape(3, 3))
    )
    return root


def _link_names(model: Any, chosen: list[int]) -> list[str]:
    return [f"{model.body(model.jnt_bodyid[j]).name or 'body'}_{k}" for k, j in enumerate(chosen, 1)]


def _carrying(mujoco: Any, model: Any, chosen: list[int], link_of: np.ndarray) -> Iterator[CarryingBody]:
    """Per link its heaviest body, in the link's frame: parallel to the world's at q = 0, at the joint's anchor."""
    data = _at(mujoco, model, chosen, np.zeros(len(chosen)))
    for k, (j, link) in enumerate(zip(chosen, _link_names(model, chosen), strict=True), 1):
        bodies = [b for b in range(1, model.nbody) if link_of[b] == k]
        body = max(bodies, key=lambda b: (model.body_mass[b], b == model.jnt_bodyid[j]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body] - data.xanchor[j]
        mass, centre, inertia = _lumped(model, data, [body])
        own = parameters(mass, centre - data.xanchor[j], inertia)
        yield CarryingBody(model.body(body).name, pose, own, link, np.eye(4))


def _at(mujoco: Any, model: Any, chosen: list[int], q: np.ndarray) -> Any:
    """MjData with the chosen joints at q (n,), all others where the file starts them."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[model.jnt_qposadr[chosen]] = q
    mujoco.mj_kinematics(model, data)
    return data


def _lumped(model: Any, data: Any, bodies: Sequence[int]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], centre (3,) [m] and inertia (3, 3) [kg·m²] about it of bodies together, in world axes."""
    mass = float(model.body_mass[bodies].sum())
    if mass <= 0:
        return 0.0, np.array(data.xipos[bodies[0]]), np.zeros((3, 3))
    centre = model.body_mass[bodies] @ data.xipos[bodies] / mass
    inertia = np.zeros((3, 3))
    for b in bodies:
        axes, lever = data.ximat[b].reshape(3, 3), data.xipos[b] - centre
        inertia += axes @ np.diag(model.body_inertia[b]) @ axes.T
        inertia += model.body_mass[b] * (lever @ lever * np.eye(3) - np.outer(lever, lever))
    return mass, centre, inertia


def _joint(root: Element, name: str, kind: str, parent: str, child: str, xyz: np.ndarray, rpy: np.ndarray) -> Element:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=digits(*xyz), rpy=digits(*rpy))
    return joint


def _check(mujoco: Any, model: Any, arm: SimulatedArm, chosen: list[int]) -> None:
    """Raise InputError unless what was read gives MuJoCo's own torque: then something acts that was not read."""
    robot, _ = described(arm, None)
    smooth = replace(arm, frictionloss=0 * arm.frictionloss)  # which MuJoCo has as a constraint
    q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, 10, len(chosen)))
    torque = model_of(smooth, robot, {}).predict(q, qd, qdd, np.arange(10.0))
    expected = inverse_dynamics(mujoco, model, chosen, q, qd, qdd)
    worst = np.abs(torque - expected).max(axis=0)
    if not np.all(worst <= 1e-6 * np.abs(expected).max()):
        joint = arm.file_joints[int(np.argmax(worst))]
        raise InputError(
            f"{arm.path}: something acts on {joint} that is not read here, up to {worst.max():.3g} N·m (a polynomial "
            "of damping or stiffness, armature or damping of an actuator): give it to the joint's armature, damping, "
            "frictionloss or stiffness"
        )


def inverse_dynamics(
    mujoco: Any, model: Any, chosen: Sequence[int], q: np.ndarray, qd: np.ndarray, qdd: np.ndarray
) -> np.ndarray:
    """(S, n) torque [N·m] by MuJoCo's own inverse dynamics, without constraints, gravcomp and medium."""
    bare = copy(model)
    bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    bare.opt.density = bare.opt.viscosity = 0.0
    bare.body_gravcomp[:] = 0.0
    data = mujoco.MjData(bare)
    at, dof = bare.jnt_qposadr[list(chosen)], bare.jnt_dofadr[list(chosen)]
    torque = np.empty(q.shape)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = bare.qpos0, 0.0, 0.0
        data.qpos[at], data.qvel[dof], data.qacc[dof] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(bare, data)
        torque[k] = data.qfrc_inverse[dof]
    return torque


def _model_name(path: Path) -> str:
    try:
        return str(ElementTree.parse(path).getroot().get("model") or path.stem)
    except (OSError, ElementTree.ParseError):
        return path.stem
