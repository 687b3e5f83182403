"""The robot description: `robot.yaml` next to a URDF."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError

from agent.core import LARGEST_ROBOT_FILE, InputError, load_document, read_text
from agent.robot.urdf_checks import check_urdf, parse_robot_file

STANDARD_GRAVITY = 9.80665  # m/s², by the third CGPM, 1901
_NAMED_ENDS = 8  # links of a message
_GRIPPER = re.compile(r"gripper|finger|jaw|hand", re.IGNORECASE)


def is_gripper(name: str) -> bool:
    """Whether a joint opens a hand."""
    return bool(_GRIPPER.search(name))


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


def _no_truth(value: Any) -> Any:
    """`true` would be one."""
    if isinstance(value, bool):
        raise ValueError("a number is expected")
    return value


def _of_a_size(value: float) -> float:
    """Nothing of an arm is so small or so large; what divides by it or squares it would be no number."""
    if not 1e-9 <= abs(value) <= 1e9:
        raise ValueError("no arm has that: give a number from 1e-9 to 1e9")
    return value


def _not_too_large(value: float) -> float:
    return value if abs(value) < 1e-9 else _of_a_size(value)


_Given = Annotated[float, BeforeValidator(_no_truth)]
Number = Annotated[_Given, AfterValidator(_not_too_large)]
Positive = Annotated[_Given, Field(gt=0), AfterValidator(_of_a_size)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]


class _JointEntry(_Strict):
    name: str
    gear_ratio: Annotated[_Given, AfterValidator(_of_a_size)] = 1.0
    nominal_motor_torque: Positive | None = None
    max_velocity: Positive
    max_acceleration: Positive
    max_jerk: Positive | None = None
    rotor_inertia: Annotated[Number, Field(ge=0)] | None = None
    max_torque: Positive | None = None
    torque_constant: Positive | None = None


class _CartesianEntry(_Strict):
    linear_speed: Positive
    linear_acceleration: Positive
    rotational_speed: Positive
    rotational_acceleration: Positive


class _CapsuleEntry(_Strict):
    model_config = ConfigDict(extra="forbid", populate_by_name=True)
    start: Vector3 = Field(alias="from")
    end: Vector3 = Field(alias="to")
    radius: Positive


def _file_name(name: str) -> str:
    """Runs, exports and units are named after the robot."""
    if not re.fullmatch(r"\w[\w .+-]{0,63}", name):
        raise ValueError(
            f"{name!r}: files are named after the robot, so letters, digits, blanks and . _ + - are allowed, the first "
            "a letter or digit, at most 64"
        )
    return name


class _RobotFile(_Strict):
    name: Annotated[str, AfterValidator(_file_name)]
    urdf: str
    tip_frame: str
    gravity: Vector3 = [0.0, 0.0, -STANDARD_GRAVITY]
    cartesian_limits: _CartesianEntry | None = None
    joints: Annotated[list[_JointEntry], Field(min_length=1, max_length=7)]
    motor_coupling: list[list[Number]] | None = None
    rated_payload: Positive | None = None
    bodies: dict[str, list[_CapsuleEntry]] = {}


@dataclass(frozen=True)
class Joint:
    """One movable joint. Joint side unless said otherwise; N·m, rad (N, m on a prismatic joint).

    `lower` and `upper` come from the URDF, infinite on a continuous joint and where they are missing.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    name: str
    prismatic: bool
    gear_ratio: float
    nominal_motor_torque: float | None
    max_velocity: float
    max_acceleration: float
    max_jerk: float | None
    rotor_inertia: float | None
    max_torque: float | None
    torque_constant: float | None
    lower: float
    upper: float

    @property
    def position_unit(self) -> str:
        """Unit of its position: rad, on a prismatic joint m."""
        return "m" if self.prismatic else "rad"

    @property
    def torque_unit(self) -> str:
        """Unit of its torque: N·m, on a prismatic joint N."""
        return "N" if self.prismatic else "N·m"


@dataclass(frozen=True)
class CartesianLimits:
    """Limits at the tool centre point: m/s, m/s², rad/s, rad/s²."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    linear_speed: float
    linear_acceleration: float
    rotational_speed: float
    rotational_acceleration: float


@dataclass(frozen=True)
class Box:
    """A stationary box that no part of the arm may enter: opposite corners (3,) in the base frame [m]."""

    name: str
    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]


@dataclass(frozen=True)
class Capsule:
    """A segment with a radius, in its link's frame [m]."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class RobotDescription:
    """A serial arm with 1 to 7 movable joints; self-contained (the URDF is held as text).

    `rated_payload` [kg] is the most that its maker allows at the flange, the tool included.
    """

    name: str
    urdf: str = field(repr=False)
    tip_frame: str
    gravity: tuple[float, float, float]
    cartesian_limits: CartesianLimits | None
    joints: tuple[Joint, ...]
    motor_coupling: tuple[tuple[float, ...], ...]
    bodies: dict[str, tuple[Capsule, ...]] = field(default_factory=dict)
    rated_payload: float | None = None

    @property
    def dof(self) -> int:
        """Number of joints n."""
        return len(self.joints)

    @property
    def weight_per_mass(self) -> float:
        """Size of gravity [m/s²]; the standard one where it is described as none."""
        return float(np.linalg.norm(self.gravity)) or STANDARD_GRAVITY

    @property
    def load_link(self) -> int:
        """The link that carries a load, from 0: the last one that is no gripper's."""
        arm = [k for k, joint in enumerate(self.joints) if not is_gripper(joint.name)]
        return arm[-1] if arm else self.dof - 1

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names in order, base to tip."""
        return tuple(joint.name for joint in self.joints)

    @property
    def gear_ratios(self) -> np.ndarray:
        """(n,) motor turns per joint turn, signed."""
        return np.array([joint.gear_ratio for joint in self.joints])

    @property
    def coupling(self) -> np.ndarray:
        """(n, n) matrix C: q̇_motor = diag(gear_ratio) C q̇ and τ = Cᵀ diag(gear_ratio) τ_motor."""
        return np.array(self.motor_coupling)

    @property
    def nominal_torque(self) -> np.ndarray:
        """(n,) |gear ratio| · nominal motor torque [N·m], NaN where the description has none."""
        return np.array(
            [
                np.nan if joint.nominal_motor_torque is None else abs(joint.gear_ratio) * joint.nominal_motor_torque
                for joint in self.joints
            ]
        )

    @property
    def max_velocity(self) -> np.ndarray:
        """(n,) rad/s."""
        return np.array([joint.max_velocity for joint in self.joints])

    @property
    def max_acceleration(self) -> np.ndarray:
        """(n,) rad/s²."""
        return np.array([joint.max_acceleration for joint in self.joints])

    @property
    def position_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) lower and (n,) upper [rad]."""
        return np.array([j.lower for j in self.joints]), np.array([j.upper for j in self.joints])

    def to_dict(self) -> dict[str, Any]:
        """Plain data that `from_dict` turns back into an equal description."""
        from dataclasses import asdict

        data = asdict(self)
        for joint in data["joints"]:
            joint.update({end: None for end in ("lower", "upper") if np.isinf(joint[end])})
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RobotDescription:
        """The inverse of `to_dict`, also after a round trip through JSON.

        Raises:
            ValueError: a value that is none of a description; KeyError: one is missing of a joint.
        """
        open_ends = (("lower", -np.inf), ("upper", np.inf))
        joints = [joint | {end: value for end, value in open_ends if joint[end] is None} for joint in data["joints"]]
        if len(data["gravity"]) != 3:
            raise ValueError("gravity is three numbers")
        try:
            return _described().validate_python(data | {"name": _file_name(data["name"]), "joints": joints})
        except ValidationError as error:
            fault = error.errors()[0]
            raise ValueError(f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}") from None


@cache
def _described() -> TypeAdapter[RobotDescription]:
    return TypeAdapter(RobotDescription)


def builtin_robots() -> tuple[str, ...]:
    """Names of the robots that come with the agent."""
    folder = files("agent.robot") / "catalogue"
    return tuple(sorted(entry.name for entry in folder.iterdir() if (entry / "robot.yaml").is_file()))


def load_robot(name_or_path: str | Path) -> RobotDescription:
    """Load a built-in robot by name, or a description file by path.

    Raises:
        InputError: unknown name, or a file that breaks the format; names file, line and key.
    """
    path = description_file(name_or_path)
    return _load_builtin(path) if str(name_or_path) in builtin_robots() else _load_file(path)


def description_file(name_or_path: str | Path) -> Path:
    """The file of a built-in robot, or of a description that is named by its path or folder.

    Raises:
        InputError: neither.
    """
    if str(name_or_path) in builtin_robots():
        return Path(str(files("agent.robot") / "catalogue" / str(name_or_path) / "robot.yaml"))
    path = Path(name_or_path)
    if path.is_dir():
        path = path / "robot.yaml"
    if not path.exists():
        raise InputError(
            f"robot {str(name_or_path)!r}: neither a built-in robot ({', '.join(builtin_robots())}) nor a file"
        )
    if path.suffix.lower() in (".urdf", ".xml", ".mjcf", ".xacro", ".sdf"):
        raise InputError(
            f"{path}: a URDF or MJCF alone does not say enough of the drives here: write a robot.yaml for it "
            "(docs/how-to-robot.md)"
        )
    return path


def _load_file(path: Path) -> RobotDescription:
    entry = load_document(path, _RobotFile)
    urdf_path = path.parent / entry.urdf
    try:
        urdf = read_text(urdf_path, LARGEST_ROBOT_FILE)
    except InputError as error:
        raise InputError(f"{path}: urdf: {error}") from None
    root = parse_robot_file(urdf_path, urdf.encode())
    if root.tag == "mujoco":
        raise InputError(f"{path}: urdf: {urdf_path} is an MJCF: name it with --robot instead of {path.name}")
    check_urdf(urdf_path, root, [joint.name for joint in entry.joints])
    elements = {joint.get("name"): joint for joint in root.findall("joint")}
    links = {link.get("name") for link in root.findall("link")}
    if entry.tip_frame not in links and entry.tip_frame not in elements:
        inner = {parent.get("link") for parent in root.iterfind("joint/parent")}
        ends = ", ".join(sorted(str(link) for link in links - inner)[:_NAMED_ENDS])
        raise InputError(
            f"{path}: tip_frame: the URDF has no link {entry.tip_frame!r}; those at the end of a branch are {ends}"
        )
    for link in entry.bodies:
        if link not in links:
            raise InputError(f"{path}: bodies.{link}: the URDF has no such link")
    joints = [_joint(path, joint, elements) for joint in entry.joints]
    resolved = {"urdf": urdf, "joints": joints, "motor_coupling": _coupling(path, entry)}
    return RobotDescription.from_dict(entry.model_dump() | resolved)


_load_builtin = cache(_load_file)


def _joint(path: Path, entry: _JointEntry, elements: dict[str | None, ElementTree.Element]) -> dict[str, Any]:
    element = elements.get(entry.name)
    kind = None if element is None else element.get("type")
    if element is None or kind not in ("revolute", "continuous", "prismatic"):
        movable = [str(n) for n, e in elements.items() if e.get("type") in ("revolute", "continuous", "prismatic")]
        raise InputError(f"{path}: joints: {entry.name!r} is not a movable joint of the URDF ({', '.join(movable)})")
    limit = element.find("limit")
    ends = {} if kind == "continuous" or limit is None else limit.attrib
    lower, upper = float(ends.get("lower", "-inf")), float(ends.get("upper", "inf"))
    if not lower < upper:
        raise InputError(f"{path}: joints: {entry.name}: the URDF's limits are {lower} to {upper}: an empty range")
    return entry.model_dump() | {"prismatic": kind == "prismatic", "lower": lower, "upper": upper}


def _coupling(path: Path, entry: _RobotFile) -> list[list[float]]:
    n = len(entry.joints)
    if entry.motor_coupling is None:
        return [[float(i == j) for j in range(n)] for i in range(n)]
    matrix = entry.motor_coupling
    if len(matrix) != n or any(len(row) != n for row in matrix):
        raise InputError(f"{path}: motor_coupling: {n} rows of {n} numbers are expected")
    if abs(np.linalg.det(np.array(matrix))) < 1e-9:
        raise InputError(f"{path}: motor_coupling: the matrix is singular, so motors do not determine the joints")
    return matrix
