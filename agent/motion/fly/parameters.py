"""What public sources leave open about the controller's interpolator, as numbers that can be changed."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FlyParameters:
    """Choices of the FLY interpolator; `docs/decisions/fly-*.md` give the reasons.

    blend: how one move hands over to the next: `polynomial`, or along a `parabola` or a `circle` that touches both.
    blend_shape: of a polynomial: 0 is a cubic, 1 a quintic (rounder start, sharper middle).
    blend_turn: the orientation in a blend goes as the `path` does, or by `slerp` from one move's to the next one's.
    turn_lever: [m/rad] converts a rotation into travel of the tool where a move does little but rotate: blends take
    equal parts of the path measured so.
    ramps: `window`, speeds as high as limits allow at each place, averaged over a time; or `blocks`, one speed and one
    acceleration for a move, one speed for a corner.
    acceleration: part of the arm's acceleration limits that is planned for.
    rise: [s] of `blocks`, in which the acceleration of a ramp rises to its full; 0 is a trapezoidal speed.
    ramp: length of the jerk-limited ramps, in units of the longest (acceleration limit / jerk limit) of the joints.
    jerk_time: [s] from zero to full acceleration of a joint whose description gives no jerk limit.
    stress_floor: part of the acceleration limits that a blend may use however low `$STRESS_PER` is; at 100 it is all.
    auto_tightness: FLY_AUTO gives `1 - auto_tightness · $STRESS_PER / 100` of the half segment to the blend.
    curve_share: part of the TCP acceleration limits that may go into the curve of a blend, the rest changes the speed;
    of `blocks` part of those of the joints too.
    curve_turns: of `blocks`, whether that holds for the rotational acceleration too.
    stop_angle: [rad] corners that turn by more than this cannot be blended; the arm stops there.
    norm_acceleration: [m/s²] of FLY_NORM's overlap where the robot has no Cartesian limits.
    singular_slowdown: refuse a path where joint speed limits leave less than this part of the programmed speed.
    singular_distance: normalised distance from a singularity that `$SING_CARE` asks for.
    spacing: [m] between the points of the path at which inverse kinematics is solved.
    longest: [s] no planned motion may take longer.
    """

    blend: str = "polynomial"
    blend_shape: float = 0.0
    blend_turn: str = "path"
    turn_lever: float = 0.1
    ramps: str = "window"
    acceleration: float = 1.0
    rise: float = 0.1
    ramp: float = 1.5
    jerk_time: float = 0.08
    stress_floor: float = 0.5
    auto_tightness: float = 0.8
    curve_share: float = 0.8
    curve_turns: bool = True
    stop_angle: float = 2.97
    norm_acceleration: float = 1.7
    singular_slowdown: float = 0.01
    singular_distance: float = 0.05
    spacing: float = 0.008
    longest: float = 3600.0
