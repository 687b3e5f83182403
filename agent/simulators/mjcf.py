"""An MJCF as a simulator. MuJoCo's own package reads it, and so resolves defaults, includes and units."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from agent.core import InputError, needed
from agent.model import body_parameters
from agent.simulators.arm import CarryingBody, SimulatedArm, plain_joint, plain_robot, smooth_torque
from agent.simulators.joints import Match, leaving_out, listed
from agent.simulators.servos import position_servos, pulled_joints
from agent.simulators.urdf import digits, rpy_of, set_inertial

#: Limits of the compilation of one file: seconds of processor time, bytes of memory.
_SECONDS, _MEMORY = 10, 4 << 30
_COMPILE = """
import json, resource, sys
path, place, excluded, seconds, memory = sys.argv[1:]
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds)))
resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
import mujoco
try:
    model = mujoco.MjModel.from_xml_path(path)
    if excluded := json.loads(excluded):
        spec = mujoco.MjSpec.from_file(path)
        for one, other in excluded:
            spec.add_exclude(bodyname1=one, bodyname2=other)
        model = spec.compile()
    mujoco.mj_saveModel(model, place)
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


@contextmanager
def without_warnings() -> Iterator[None]:
    """Without MuJoCo's warnings: it prints them, and writes them to MUJOCO_LOG.TXT wherever the command runs."""
    mujoco = mujoco_package()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def compiled(path: Path, excluded: Sequence[tuple[str, str]] = ()) -> Any:
    """The compiled model (MjModel) of a file; pairs of bodies that are `excluded` do not collide.

    Raises:
        InputError: MuJoCo does not accept it; its own words are passed on.
    """
    mujoco = mujoco_package()
    with tempfile.TemporaryDirectory(prefix="calibration-agent-") as folder:
        binary = Path(folder) / "arm.mjb"
        complaint = _compile_apart(path, binary, excluded)
        if not binary.is_file():
            missing = (
                ". Files that it includes, meshes too, belong where it names them"
                if "opening file" in complaint
                else ""
            )
            raise InputError(f"{path}: MuJoCo does not accept it: {complaint}{missing}")
        return mujoco.MjModel.from_binary_path(str(binary))


def _compile_apart(path: Path, binary: Path, excluded: Sequence[tuple[str, str]]) -> str:
    """Compile in a separate process, which writes the model to the path `binary`; return MuJoCo's messages.

    A few lines may ask for a hundred million bodies, and nothing ends MuJoCo on the way: the process has a limit of
    processor time and memory, and is ended with this one.
    """
    told_apart = (str(path.resolve()), str(binary), json.dumps(list(excluded)), str(_SECONDS), str(_MEMORY))
    command = [sys.executable, "-c", _COMPILE, *told_apart]
    blind = {**os.environ, "MUJOCO_GL": "disable"}  # nothing is drawn: a library for windows is not loaded
    with subprocess.Popen(command, cwd=binary.parent, env=blind, stdout=-1, stderr=-3, stdin=-3) as process:
        try:
            output, _ = process.communicate(timeout=10 * _SECONDS)
        except subprocess.TimeoutExpired:
            output = b""
        finally:
            process.kill()
    output = b" ".join(output.split())
    too_much = f"it takes more than {_SECONDS} s of processor time, or {_MEMORY >> 30} GiB of memory, to compile"
    return output.decode(errors="replace") or too_much


def read_mjcf(path: Path, root: Element, match: Match) -> SimulatedArm:
    """The arm of an MJCF; joints that `match` leaves out are held where the file starts them.

    Raises:
        InputError: not accepted by MuJoCo, closed loops, tendons or polynomials that act on the arm, or no one chain.
    """
    scene = _Scene(path, match)
    model, chosen = scene.model, scene.chosen
    urdf, carrying = scene.as_urdf()
    dof, limited = model.jnt_dofadr[chosen], model.jnt_limited[chosen].astype(bool)
    lower, upper = np.where(limited, model.jnt_range[chosen].T, [[-np.inf], [np.inf]])
    joints = map(plain_joint, scene.joint_names, map(scene.slides, chosen), lower, upper)
    arm = SimulatedArm(
        path=path,
        robot=plain_robot(str(root.get("model") or path.stem), urdf, _TIP, scene.gravity, joints),
        file_joints=tuple(scene.names[j] for j in chosen),
        armature=np.array(model.dof_armature[dof]),
        damping=np.array(model.dof_damping[dof]),
        frictionloss=np.array(model.dof_frictionloss[dof]),
        impedance=np.array(model.dof_solimp[dof, 0]),
        stiffness=np.array(model.jnt_stiffness[chosen]),
        rest=np.array(model.qpos_spring[model.jnt_qposadr[chosen]]),
        carrying=carrying,
        notes=tuple(scene.notes()),
        servos=position_servos(scene.mujoco, model, chosen),
        step=float(model.opt.timestep),
        integrator=scene.integrator,
        solver=tuple(map(scene.solver, chosen)),
        model=model,
    )
    scene.check(arm)
    return arm


def branches_of(model: Any) -> list[list[str]]:
    """Joints of every branch of a compiled model, base to tip, without those coupled by an equality."""
    mujoco = mujoco_package()
    ties = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
    tied = {*model.eq_obj1id[ties].tolist(), *model.eq_obj2id[ties].tolist()}
    free = {j: name for j, name in _single_axes(mujoco, model).items() if name and j not in tied}
    branches: list[list[str]] = [[]]
    for body in range(1, model.nbody):
        own = [name for j, name in free.items() if model.jnt_bodyid[j] == body]
        branches.append(branches[model.body_parentid[body]] + own)
    return branches


def _single_axes(mujoco: Any, model: Any) -> dict[int, str]:
    """Hinge and slide joints, with their names."""
    kinds = mujoco.mjtJoint
    single = (model.jnt_type == kinds.mjJNT_HINGE) | (model.jnt_type == kinds.mjJNT_SLIDE)
    return {j: model.joint(j).name for j in np.flatnonzero(single).tolist()}


class _Scene:
    """A compiled MJCF, some of whose joints (`chosen`, from base to tip, as MuJoCo orders them) are the arm's.

    `used`: their names in the file → in the arm; `link_of` (bodies,): which link each body is part of, from 0 for the
    base; link k is moved by the k-th chosen joint.
    """

    def __init__(self, path: Path, match: Match):
        self.path, self.mujoco, self.model = path, mujoco_package(), compiled(path)
        self.names = _single_axes(self.mujoco, self.model)
        self.used = match([name for name in self.names.values() if name], partial(branches_of, self.model))
        self.chosen = [j for j, name in self.names.items() if name in self.used]
        self.joint_names = tuple(self.used[self.names[j]] for j in self.chosen)
        self.link_of = np.zeros(self.model.nbody, dtype=int)
        # no serial arm, or forces on the arm that are not supported
        for reason in chain(
            self._branches(), self._floating_base(), self._equalities(), self._tendons(), self._disabled()
        ):
            raise InputError(f"{path}: {reason}")

    @property
    def gravity(self) -> list[float]:
        """Three components [m/s²]."""
        off = self.model.opt.disableflags & int(self.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        return [0.0] * 3 if off else [float(part) for part in self.model.opt.gravity]

    @property
    def integrator(self) -> str:
        """As a file calls it."""
        name = self.mujoco.mjtIntegrator(self.model.opt.integrator).name.removeprefix("mjINT_")
        return {"EULER": "Euler", "RK4": "RK4"}.get(name, name.lower())

    def solver(self, joint: int) -> dict[str, str]:
        """How friction and limits of a joint are solved, as attributes of a file, where that is not the usual way."""
        model, usual = self.model, self.mujoco.MjSpec().worldbody.add_joint()
        dof = model.jnt_dofadr[joint]
        ways = {
            "solreffriction": (model.dof_solref[dof], usual.solref_friction),
            "solimpfriction": (model.dof_solimp[dof], usual.solimp_friction),
            "solreflimit": (model.jnt_solref[joint], usual.solref_limit),
            "solimplimit": (model.jnt_solimp[joint], usual.solimp_limit),
            "margin": (model.jnt_margin[joint : joint + 1], [usual.margin]),
        }
        return {name: digits(*own) for name, (own, other) in ways.items() if not np.array_equal(own, other)}

    def slides(self, joint: int) -> bool:
        """Whether a joint is prismatic."""
        return bool(self.model.jnt_type[joint] == self.mujoco.mjtJoint.mjJNT_SLIDE)

    def _branches(self) -> Iterator[str]:
        """Joints that do not form one chain; assigns every body to its link on the way."""
        model = self.model
        for body in range(1, model.nbody):
            link = self.link_of[model.body_parentid[body]]
            own = [k for k, j in enumerate(self.chosen) if model.jnt_bodyid[j] == body]
            moved = [self.names[self.chosen[k]] for k in own]
            if len(own) > 1:
                yield (
                    f"{listed(moved)} move one body ({model.body(body).name!r}), and every joint needs a link of its "
                    f"own: give each a body, or {leaving_out(self.used, moved)}"
                )
            if own and link != own[0]:
                yield (
                    f"{moved[0]} is on another branch than {self.names[self.chosen[own[0] - 1]]}. One serial arm is "
                    f"compared at a time, without other branches: {leaving_out(self.used, moved)}"
                )
            self.link_of[body] = own[0] + 1 if own else link

    def _floating_base(self) -> Iterator[str]:
        model, body = self.model, int(self.model.jnt_bodyid[self.chosen[0]])
        while body > 0:
            for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                if j not in self.names:
                    yield (
                        f"the arm's base floats (joint of body {model.body(body).name!r}): delete that joint, so that "
                        "the base stands"
                    )
            body = int(model.body_parentid[body])

    def _equalities(self) -> Iterator[str]:
        model, kinds = self.model, self.mujoco.mjtEq
        for k in np.flatnonzero(model.eq_active0).tolist():
            kind, first, second = model.eq_type[k], int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
            if kind == kinds.mjEQ_CONNECT or kind == kinds.mjEQ_WELD:
                of_sites = model.eq_objtype[k] == self.mujoco.mjtObj.mjOBJ_SITE
                ends = model.site_bodyid[[first, second]].tolist() if of_sites else [first, second]
                links = self.link_of[ends]
                if links[0] != links[1] and links.max() > 0:
                    yield (
                        f"the equality {model.eq(k).name or k!r} closes a loop between {model.body(ends[0]).name!r} "
                        f"and {model.body(ends[1]).name!r}: a serial arm is compared; make an open chain of it, or "
                        "delete it"
                    )
            elif kind == kinds.mjEQ_JOINT and first in self.chosen:
                other = "a constant" if second < 0 else repr(model.joint(second).name)
                yield (
                    f"joint {self.names[first]!r} follows {other} (equality), and joints that all move on their own "
                    f"are compared: {leaving_out(self.used, [self.names[first]])}"
                )

    def _tendons(self) -> Iterator[str]:
        model = self.model
        for k in range(model.ntendon):
            pulled = pulled_joints(self.mujoco, model, k)
            keys = ("stiffness", "damping", "frictionloss", "armature")
            acts = any(getattr(model, f"tendon_{key}")[k] for key in keys if hasattr(model, f"tendon_{key}"))
            if acts and (not pulled or set(pulled) & set(self.chosen)):
                yield (
                    f"tendon {model.tendon(k).name or k!r} has stiffness, damping, friction or armature of its own on "
                    "the arm, which is not read: give them to joints, or delete the tendon"
                )

    def _disabled(self) -> Iterator[str]:
        bits = self.mujoco.mjtDisableBit
        for part in ("frictionloss", "limit", "actuation"):
            if self.model.opt.disableflags & int(getattr(bits, f"mjDSBL_{part.upper()}")):
                yield f"its flag {part} is disabled, so its numbers do not act: enable it, or delete these numbers too"

    def notes(self) -> Iterator[str]:
        """Notes on what was held or left out."""
        model, link_of = self.model, self.link_of
        others = [j for j in range(model.njnt) if j not in self.chosen]
        for on_arm, remark in (
            (True, "held where the file starts it: not among the joints compared"),
            (False, "ignored: no part of the arm"),
        ):
            names = [model.joint(j).name or "(no name)" for j in others if (link_of[model.jnt_bodyid[j]] > 0) == on_arm]
            if names:
                yield f"{', '.join(names)} {remark}"
        if np.any(model.body_gravcomp[link_of > 0]):
            yield "gravcomp is ignored: a robot's measured torque carries its weight"
        if model.opt.density or model.opt.viscosity:
            yield "the medium (density, viscosity) is ignored"

    def as_urdf(self) -> tuple[Element, tuple[CarryingBody, ...]]:
        """The arm as a URDF at q = 0, and which body takes a change of each link.

        All links' frames are parallel to the world's, bodies lumped into the link that carries them.
        """
        model, chosen = self.model, self.chosen
        data = self.mujoco.MjData(model)
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[chosen]] = 0.0
        self.mujoco.mj_kinematics(model, data)
        root, links, carrying = Element("robot", name="arm"), [_BASE], []
        SubElement(root, "link", name=_BASE)
        anchors = np.vstack([np.zeros(3), data.xanchor[chosen]])
        for k, (j, name) in enumerate(zip(chosen, self.joint_names, strict=True), 1):
            own = np.flatnonzero(self.link_of == k).tolist()
            blocks = {b: _block(model, data, b, anchors[k]) for b in own}
            links.append(f"{model.body(model.jnt_bodyid[j]).name or 'body'}_{k}")
            link, total = SubElement(root, "link", name=links[k]), np.sum(list(blocks.values()), axis=0)
            if total[0] > 0:
                set_inertial(link, total)
            kind = "prismatic" if self.slides(j) else "continuous"
            joint = _joint(root, name, kind, links[k - 1], links[k], anchors[k] - anchors[k - 1])
            SubElement(joint, "axis", xyz=digits(*data.xaxis[j]))
            if self.slides(j):
                SubElement(joint, "limit", lower="-1e9", upper="1e9", effort="1e9", velocity="1e9")
            heaviest = max(own, key=lambda b: (model.body_mass[b], b == model.jnt_bodyid[j]))
            pose = _pose(data, heaviest, anchors[k])
            carrying.append(CarryingBody(model.body(heaviest).name, pose, blocks[heaviest], links[k], np.eye(4)))
        SubElement(root, "link", name=_TIP)
        tip = _pose(data, int(model.jnt_bodyid[chosen[-1]]), anchors[-1])
        _joint(root, "to_tip", "fixed", links[-1], _TIP, tip[:3, 3], rpy_of(tip))
        return root, tuple(carrying)

    def check(self, arm: SimulatedArm) -> None:
        """Raise InputError unless the arm as read gives MuJoCo's own torque: else some force was not read."""
        model, at_joint = self.model, int(self.mujoco.mjtTrn.mjTRN_JOINT)
        by_itself = int(getattr(self.mujoco.mjtBias, "mjBIAS_DCMOTOR", -1))
        for a, kind in enumerate(model.actuator_biastype):
            if (
                kind == by_itself
                and model.actuator_trntype[a] == at_joint
                and model.actuator_trnid[a, 0] in self.chosen
            ):
                raise InputError(
                    f"{arm.path}: friction or cogging of the dcmotor {model.actuator(a).name!r} is not read here: take "
                    "it out, or give the file from which agent export made this one"
                )
        q, qd, qdd = np.random.default_rng(0).uniform(-1, 1, (3, 10, len(self.chosen)))
        torque = smooth_torque(arm, q, qd, qdd)
        expected = self._inverse_dynamics(q, qd, qdd)
        worst = np.abs(torque - expected).max(axis=0)
        if not np.all(worst <= 1e-6 * np.abs(expected).max()):
            joint = arm.file_joints[int(np.argmax(worst))]
            raise InputError(
                f"{arm.path}: something acts on {joint} that is not read here, up to {worst.max():.3g} N·m (a "
                "polynomial of damping or stiffness, armature or damping of an actuator): give it to the joint's "
                "armature, damping, frictionloss or stiffness"
            )

    def _inverse_dynamics(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """(S, n) torque [N·m] by MuJoCo's own inverse dynamics, without constraints, gravcomp and medium."""
        bare = copy(self.model)
        bare.opt.disableflags |= int(self.mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        bare.opt.density = bare.opt.viscosity = 0.0
        bare.body_gravcomp[:] = 0.0
        data = self.mujoco.MjData(bare)
        at, dof = bare.jnt_qposadr[self.chosen], bare.jnt_dofadr[self.chosen]
        torque = np.empty(q.shape)
        data.qpos[:] = bare.qpos0
        for k in range(len(q)):
            data.qpos[at], data.qvel[dof], data.qacc[dof] = q[k], qd[k], qdd[k]
            self.mujoco.mj_inverse(bare, data)
            torque[k] = data.qfrc_inverse[dof]
        return torque


def _block(model: Any, data: Any, body: int, origin: np.ndarray) -> np.ndarray:
    """(10,) inertial parameters of a body, in world axes about an origin (3,)."""
    axes = data.ximat[body].reshape(3, 3)
    inertia = axes @ np.diag(model.body_inertia[body]) @ axes.T
    return body_parameters(float(model.body_mass[body]), data.xipos[body] - origin, inertia)


def _pose(data: Any, body: int, origin: np.ndarray) -> np.ndarray:
    """(4, 4) of a body's frame, in world axes at an origin (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body] - origin
    return pose


def _joint(
    root: Element, name: str, kind: str, parent: str, child: str, xyz: np.ndarray, rpy: np.ndarray | None = None
) -> Element:
    joint = SubElement(root, "joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    SubElement(joint, "origin", xyz=digits(*xyz), rpy=digits(*(np.zeros(3) if rpy is None else rpy)))
    return joint
