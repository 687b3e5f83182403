"""Compares positions and torques with what the description says: ranges, speeds, drives, reach, masses, gravity.

A pendulum's torque fits gravity in any direction of its plane of motion, as its centre of mass is free; so do slow
motions of an arm with gravity upside down, or torques without any. The gravity torque of the fit is known all the same,
but for a constant, and can be compared with that of the description. A description whose inertials were never measured
says nothing here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from agent.data_quality.faults import QualityFinding, Recordings
from agent.data_quality.rigid_fit import FitSamples, RigidFit
from agent.estimation import are_placeholders
from agent.robot import Dynamics, RobotDescription

_TOO_FAR = {"degrees": 5.0, "mm": 100.0}  # times the joint's range: a tenth of what the unit makes of it, at most
_TOO_FAST = {"degrees": 10.0, "mm": 100.0}  # times its highest speed
_LEAST = {"degrees": np.pi, "mm": 0.0}  # rad or m that some joint comes to, at least
_TOO_STRONG = 100.0  # times what the description says of the drive or of gravity, from where on only N·mm is likely
HEAVIEST = 1000.0  #: kg for each square metre of reach: of 13 arms, real and simulated, the heaviest has 510
_REFUTED = 0.9  # of the gravity torque, root mean square, that the description leaves at least, and
_FITS = 0.5  # at most, with one thing undone
_SEEN = 0.2  # of a torque, and of the heaviest joint's described gravity, that gravity must make up to be judged, or
_TIMES_LEFT = 10.0  # times what a fit leaves of the torque
_SCALES = (0.25, 4.0)  # times the described gravity torque: beyond them another unit is likely
_ALIKE = 0.8  # of what friction and inertia leave of a torque, that described gravity of any size explains
_ABSENT, _VISIBLE = 0.1, 3.0  # times described gravity and share that it explains, times what is left: it is absent
_UNIT = 1.35  # times, on average, that torques in a part of nominal torque differ from what that makes of them
LIGHTEST = 1.0  #: kg for each square metre of reach: a description of less holds placeholders
MEND_GRAVITY = (
    "set `gravity` in robot.yaml to this, or turn the base of the URDF by a fixed joint to a new root link "
    "(it follows from how the base is mounted)"
)
WITH_GRAVITY = (
    "record joint torque that includes gravity: take the controller's total torque or the motor currents instead of "
    "the gravity-compensated effort (UR's ROS 2 driver: `use_currents_as_efforts: true`, the default on Humble, Jazzy "
    "and Kilted; libfranka's tau_J includes gravity)"
)


def position_units(of: Recordings) -> Iterator[QualityFinding]:
    """Degrees or mm: joints that go or run so far beyond the description that the unit must be another."""
    joints = of.robot.joints
    ends = [np.nan if j.lower is None or j.upper is None else max(abs(j.lower), abs(j.upper)) for j in joints]
    ranges = np.where(np.array(ends) > 0, ends, np.nan)
    furthest = np.max([np.abs(log.position).max(axis=0) for log in of.logs], axis=0)
    speeds = np.array([_speed(log.t, log.position, log.sample_rate) for log in of.logs]).max(axis=0)
    for which, unit, looks in ((of.turning, "rad", "degrees"), (~of.turning, "m", "mm")):
        moving_joints = which & of.moving
        if not moving_joints.any() or furthest[moving_joints].max() <= _LEAST[looks]:
            continue
        far, fast = (furthest / ranges)[moving_joints], (speeds / of.robot.max_velocity)[moving_joints]
        far = far[np.isfinite(far)]
        if (len(far) and np.median(far) > _TOO_FAR[looks]) or np.median(fast) > _TOO_FAST[looks]:
            k = int(np.flatnonzero(moving_joints)[np.argmax(fast)])
            yield QualityFinding(
                f"positions look like {looks}: {joints[k].name} comes to {furthest[k]:.4g} {unit} and moves at "
                f"{np.max(fast):.3g} times its highest speed",
                of.named(moving_joints),
            )
            return


def _speed(t: np.ndarray, position: np.ndarray, rate: float) -> np.ndarray:
    """(n,) 98 % quantile of the mean speed over 0.05 s; 0 in a log that is too short."""
    every = max(1, int(0.05 * rate))
    step, time = np.abs(np.diff(position[::every], axis=0)), np.diff(t[::every])
    return np.quantile(step / time[:, None], 0.98, axis=0) if len(time) else np.zeros(position.shape[1])


def drive_torque(robot: RobotDescription) -> np.ndarray:
    """(n,) what the description says that a drive can do [N·m or N]: its limit, else nominal; NaN where unknown."""
    drives = np.array([np.nan if joint.max_torque is None else joint.max_torque for joint in robot.joints])
    drives = np.where(drives > 0, drives, robot.nominal_torque)
    return np.where(drives > 0, drives, np.nan)


def excessive_torque(of: Recordings) -> Iterator[QualityFinding]:
    """Torque a hundred times what the drives of turning joints that move can do."""
    strong = np.max([np.quantile(np.abs(effort), 0.99, axis=0) for effort in of.efforts], axis=0)
    times = (strong / drive_torque(of.robot))[of.turning & of.moving & (strong > 0)]
    times = times[np.isfinite(times)]
    if len(times) and np.median(times) > _TOO_STRONG:
        text = f"torques look like N·mm: they are {np.median(times):.3g} times what the drives can do"
        yield QualityFinding(text, of.robot.joint_names, scale=True)


def excessive_weight(of: Recordings) -> Iterator[QualityFinding]:
    """Torque for more weight than an arm of this reach has; the last doubt, as a force for a torque looks alike.

    An arm is as long as its joints are apart, wherever its tip is: that of a surgical arm is near where its axes meet.
    """
    torque = max(float(np.quantile(np.abs(e[:, of.turning]), 0.99, axis=0).max(initial=0)) for e in of.efforts)
    q = np.random.default_rng(0).uniform(-2, 2, (50, of.robot.dof)) * of.turning
    dynamics = Dynamics(of.robot)
    apart = np.linalg.norm(dynamics.chain[1][1:], axis=1).sum()
    reach = max(float(np.linalg.norm(dynamics.tip_pose(q)[:, :3, 3], axis=1).max()), float(apart))
    mass = 2 * torque / (of.robot.weight_per_mass * reach) if reach > 0 else 0.0
    if mass > HEAVIEST * reach**2:
        yield QualityFinding(
            f"torques look like N·mm: to need {torque:.3g} N·m at a reach of {reach:.2g} m an arm would weigh "
            f"{mass:.2g} kg, more than any of its reach ({HEAVIEST * reach**2:.2g} kg)",
            of.named(of.turning),
            scale=True,
        )


def gravity_axes(robot: RobotDescription) -> Iterator[tuple[float, float, float]]:
    """Gravity [m/s²] along each axis of the base, downwards first, but not as it is described."""
    size = robot.weight_per_mass
    for direction in (*-np.eye(3)[::-1], *np.eye(3)):
        x, y, z = (size * direction + 0.0).tolist()
        if not np.allclose((x, y, z), robot.gravity, atol=1e-3 * size):
            yield x, y, z


def gravity_text(robot: RobotDescription, gravity: tuple[float, float, float]) -> str:
    """Its direction as a user writes it, and how far it is from the described one."""
    a, b = np.array(robot.gravity), np.array(gravity)
    angle = np.degrees(np.arccos(np.clip(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12), -1, 1)))
    return f"gravity in the base frame looks like ({', '.join(f'{x:.4g}' for x in b)}), {angle:.0f}° from the described"


def described_gravity(
    robot: RobotDescription, s: FitSamples, fitted: np.ndarray, unexplained: float
) -> Iterator[QualityFinding]:
    """The direction of gravity that the described masses need for a fit's gravity torque.

    Parameters
    ----------
    robot : description with the masses
    s : samples of the fit
    fitted : (S, n) gravity torque of the fit [N·m or N]
    unexplained : part of the torque that the fit leaves
    """
    masses, turning = _measured_masses(robot), ~np.array([joint.prismatic for joint in robot.joints])
    if masses is None:
        return

    def varying(torque: np.ndarray) -> np.ndarray:
        return (torque - torque.mean(axis=0))[:, turning]

    def residual(gravity: tuple[float, float, float]) -> float:
        """What the described masses leave of the gravity torque."""
        weight = Dynamics(replace(robot, gravity=gravity)).regressor(s.q, 0 * s.q, 0 * s.q) @ masses
        return float(np.linalg.norm(varying(fitted) - varying(weight)))

    length = float(np.linalg.norm(varying(fitted)))
    least = min(_SEEN, _TIMES_LEFT * unexplained) * float(np.linalg.norm(varying(s.torque)))
    if length < least or residual(robot.gravity) < _REFUTED * length:
        return
    best = min(gravity_axes(robot), key=residual)
    if residual(best) < _FITS * length:
        held_out = _unweighed(robot, s, masses, robot.gravity) / _unweighed(robot, s, masses, best)
        yield QualityFinding(
            f"{gravity_text(robot, best)}, or the described centres of mass are wrong: of the gravity torque, the "
            f"described masses explain {100 * (1 - residual(best) / length):.0f} % so, and none as given",
            robot.joint_names,
            advice=MEND_GRAVITY,
            refuses=bool(np.log(held_out).mean() > 0),
        )


@dataclass(frozen=True, eq=False)
class DescribedWeight:
    """How the torque of the joints that carry most compares with the described gravity.

    Attributes
    ----------
    joints : (k,) numbers of these joints.
    times : (k,) their torque as a multiple of gravity.
    alike : (k,) whether gravity of any size explains most of what friction and inertia leave.
    absent : (k,) whether they show next to none.
    root_mean_square : of the largest gravity torque [N·m].
    """

    joints: np.ndarray
    times: np.ndarray
    alike: np.ndarray
    absent: np.ndarray
    root_mean_square: float

    def off(self) -> np.ndarray:
        """(k,) joints whose gravity is beyond what wrong masses make of it."""
        return self.alike & ((self.times < _SCALES[0]) | (self.times > _SCALES[1]))


def compared_weight(of: Recordings) -> DescribedWeight | None:
    """Torque against the described gravity; None where the masses or the samples say nothing."""
    robot, s, masses = of.robot, of.samples, _measured_masses(of.robot)
    if s is None or masses is None:
        return None
    dynamics = Dynamics(robot)
    weight, whole = (dynamics.regressor(s.q, *motion) @ masses for motion in ((0 * s.q, 0 * s.q), (s.qd, s.qdd)))
    heavy = np.flatnonzero(of.turning & (np.std(weight, axis=0) > _SEEN * np.std(weight * of.turning, axis=0).max()))
    times, alike, absent = [], [], []
    for k in heavy:
        others = np.column_stack(
            [whole[:, k] - weight[:, k], s.direction[:, k], s.qd[:, k], s.qdd[:, k], np.ones(len(s.q))]
        )
        own, torque = (v - others @ np.linalg.lstsq(others, v, rcond=None)[0] for v in (weight[:, k], s.torque[:, k]))
        times.append(float(own @ torque / max(own @ own, 1e-300)))
        residual = float(np.linalg.norm(torque - times[-1] * own))
        share = 1 - residual**2 / max(float(torque @ torque), 1e-300)
        alike.append(share > _ALIKE and times[-1] > 0)
        absent.append(abs(times[-1]) < _ABSENT and share < _ABSENT and np.linalg.norm(own) > _VISIBLE * residual)
    if not len(heavy):
        return None
    largest = float(np.std(weight[:, heavy], axis=0).max())
    return DescribedWeight(heavy, np.array(times), np.array(alike, bool), np.array(absent, bool), largest)


def described_weight(of: Recordings) -> Iterator[QualityFinding]:
    """Torque that carries no gravity, or is like the described gravity in all but its size, joint by joint."""
    weight = compared_weight(of)
    if weight is not None and weight.absent.all():
        whose = of.named(weight.joints)
        yield QualityFinding(
            f"these torques carry no gravity: the described masses need {weight.root_mean_square:.3g} N·m of it, root "
            f"mean square, and {', '.join(whose)} show next to none",
            whose,
            advice=WITH_GRAVITY,
            refuses=_fits_without_gravity(of),
        )
    elif weight is not None and weight.alike.any():
        yield from _other_unit(of, weight)


def _other_unit(of: Recordings, weight: DescribedWeight) -> Iterator[QualityFinding]:
    """Torque that is a multiple of the described gravity; refused where every joint with weight is off."""
    robot = of.robot
    joints, times = weight.joints[weight.alike], weight.times[weight.alike]
    size = float(np.exp(np.mean(np.log(times))))
    if size > _TOO_STRONG:
        weighed = f"torques look like N·mm: gravity on the joints is {size:.3g} times what the described masses weigh"
        yield from [*excessive_weight(of), QualityFinding(weighed, robot.joint_names, scale=True)][:1]
        return
    off = weight.off()[weight.alike]
    unit, what = "motor currents, or % or ‰ of a nominal or stall torque", "--effort current or --effort load"
    parts = np.log(times * drive_torque(robot)[joints])
    for name, whole in (("%", 100.0), ("‰", 1000.0)):
        wrong = np.mean(np.abs(parts - np.log(whole)))
        if wrong < np.log(_UNIT) < np.mean(np.abs(np.log(times))) / 2:
            unit, off, what = f"{name} of nominal torque", np.ones(len(joints), bool), "--effort load"
    if not off.any():
        return
    every = int(off.sum()) == len(weight.joints)
    whose = robot.joint_names if every else of.named(joints[off])
    sizes = ", ".join(f"{robot.joint_names[k]} {x:.2g}" for k, x in zip(joints[off], times[off], strict=True))
    yield QualityFinding(
        f"the torques of {', '.join(whose)} look like another unit ({unit}) in 100 % of the samples: as multiples of "
        f"what the described masses weigh, their gravity is {sizes}",
        whose,
        advice=f"say what they are with {what}, or correct the masses of the description",
        refuses=every,
        scale=True,
    )


def _fits_without_gravity(of: Recordings) -> bool:
    """Whether samples held out fit better without the described gravity than with it."""
    masses, s = _measured_masses(of.robot), of.samples
    if masses is None or s is None:
        return False
    with_it, without = (_unweighed(of.robot, s, masses, gravity) for gravity in (of.robot.gravity, (0.0, 0.0, 0.0)))
    return bool(np.log(with_it / without).mean() > 0)


def _unweighed(
    robot: RobotDescription, s: FitSamples, masses: np.ndarray, gravity: tuple[float, float, float]
) -> np.ndarray:
    """(FOLDS, n) squared error held out of a rigid arm without weight, on the torque less that of described masses."""
    weight = Dynamics(replace(robot, gravity=gravity)).regressor(s.q, 0 * s.q, 0 * s.q) @ masses
    return RigidFit(Dynamics(replace(robot, gravity=(0.0, 0.0, 0.0))), s).errors(s.torque - weight)


def _measured_masses(robot: RobotDescription) -> np.ndarray | None:
    """(10 n,) standard parameters of the description; None where nobody measured them."""
    dynamics = Dynamics(robot)
    masses = dynamics.standard_parameters()
    too_light = masses[::10].sum() < LIGHTEST * dynamics.reach**2
    return None if are_placeholders(masses) or too_light else masses
