"""Parameters for the properties of the controller's interpolator that public sources leave open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import ConfigDict, Field

Share = Annotated[float, Field(ge=0, le=1)]

#: [s] No planned motion takes longer.
LONGEST = 3600.0
#: [m] Largest distance between points of the path at which inverse kinematics is solved.
SPACING = 0.008


@dataclass(frozen=True)
class FlyParameters:
    """Choices of the FLY interpolator; `docs/decisions/fly-*.md` give the reasons. The ranges hold for files.

    blend: one move hands over to the next by a `polynomial`, or along a `parabola` or a `circle` that touches both.
    blend_shape: of a polynomial: 0 is a cubic, 1 a quintic (rounder start, sharper middle).
    blend_turn: the orientation in a blend follows the `path`, or goes by `slerp` from one move's to the next one's.
    turn_lever: [m/rad] converts a rotation into travel of the tool where a move does little but rotate: blends take
    equal parts of the path measured so.
    ramps: `window`, speeds as high as limits allow at each point, averaged over a time; or `blocks`, one speed and one
    acceleration for a move, one speed for a corner.
    acceleration: part of the arm's acceleration limits that is planned for.
    rise: [s] of `blocks`, in which the acceleration of a ramp rises to its full; 0 is a trapezoidal speed.
    override_power: ramps take the acceleration limits times `$ARM_OVR` to this power.
    ramp: length of the jerk-limited ramps, in units of the longest (acceleration limit / jerk limit) of the joints.
    jerk_time: [s] from zero to full acceleration of a joint whose description gives no jerk limit.
    stress_floor: part of the acceleration limits that a blend may use however low `$STRESS_PER` is; at 100 it is all.
    auto_tightness: FLY_AUTO gives `1 - auto_tightness · $STRESS_PER / 100` of the half segment to the blend.
    curve_share: part of the TCP acceleration limits that may go into the curve of a blend, the rest changes the speed;
    of `blocks` part of those of the joints too.
    curve_turns: of `blocks`, whether that holds for the rotational acceleration too.
    stop_angle: [rad] corners that turn by more than this cannot be blended; the arm stops there.
    norm_acceleration: [m/s²] of FLY_NORM's overlap where the robot has no Cartesian limits.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)

    blend: Literal["polynomial", "parabola", "circle"] = "polynomial"
    blend_shape: Share = 0.0
    blend_turn: Literal["path", "slerp"] = "path"
    turn_lever: Annotated[float, Field(gt=0, le=1)] = 0.1
    ramps: Literal["window", "blocks"] = "window"
    acceleration: Annotated[float, Field(gt=0, le=1)] = 1.0
    rise: Annotated[float, Field(ge=0, le=2)] = 0.1
    override_power: Annotated[float, Field(ge=0, le=3)] = 1.0
    ramp: Annotated[float, Field(gt=0, le=20)] = 1.5
    jerk_time: Annotated[float, Field(gt=0, le=2)] = 0.08
    stress_floor: Share = 0.5
    auto_tightness: Share = 0.8
    curve_share: Annotated[float, Field(gt=0, le=1)] = 0.8
    curve_turns: bool = True
    stop_angle: Annotated[float, Field(gt=0, le=3.1)] = 2.97
    norm_acceleration: Annotated[float, Field(gt=0, le=100)] = 1.7
