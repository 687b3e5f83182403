"""The commented recipe that `agent init` writes."""

from __future__ import annotations

import re
from collections.abc import Sequence

_BARE = re.compile(r"[0-9]+(\.[0-9]+){3}:[0-9]+|[A-Za-z_][A-Za-z0-9_./-]*(:[0-9]+)?")

_TEMPLATE = """\
# Calibration recipe. Quantities are texts with a unit; a bare number is SI, where it can be meant so.
robot: {robot}                  # built-in name, or path of a robot.yaml (from this file's folder)

# tool:                         # what is mounted on the flange; all in the flange's frame
#   frame: [0 mm, 0 mm, 120 mm, 0 deg, 0 deg, 0 deg]   # x, y, z, Euler ZYZ a, e, r of the tool centre point
#   mass: 2.1 kg
#   centre_of_mass: [0 mm, 0 mm, 60 mm]

controller: {{driver: {driver}, address: {address}}}

# cell:
#   keep_out:                   # boxes that no part of the arm may enter, in the base frame
#     - {{name: table, box: {{min: [0.4 m, -1 m, 0 m], max: [1.6 m, 1 m, 0.3 m]}}}}
#   joint_ranges:               # where a cable allows less than the joint itself
#     joint_4: [-200 deg, 200 deg]

motion:
  speed: 1 m/s                  # of the tool centre point
  fly: {{type: FLY_CART, trajectory: FLY_TOL, distance: 20 mm}}
  via_points:                   # the sub-region: where the model shall be good
    count: {count}
    box:                        # in the base frame; the tool stays within `cone` of `orientation` (Euler ZYZ)
      centre: [{centre}]
      size: [{size}]
      orientation: [{orientation}]
      cone: {cone}
    # or a region for each point (without count), pose plus or minus range:
    # points:
    #   - {{pose: [1 m, 0 m, 0.8 m, 0 deg, 180 deg, 0 deg], range: [50 mm, 50 mm, 50 mm, 0 deg, 10 deg, 0 deg]}}
    #   - {{pose: [1 m, 0.3 m, 0.8 m, 0 deg, 180 deg, 0 deg], range: [50 mm, 50 mm, 50 mm, 0 deg, 10 deg, 0 deg]}}
    # or where an existing job works, a program or a log:
    # like: task.pdl
    # around: 50 mm
    # or a tube around a path:
    # tube:
    #   path:
    #     - [1 m, -0.3 m, 0.8 m, 0 deg, 180 deg, 0 deg]
    #     - [1 m, 0.3 m, 0.8 m, 0 deg, 180 deg, 0 deg]
    #   radius: 50 mm
    #   cone: 10 deg

search:                         # for the via-points that excite the parameters best
  method: genetic
  population: 50
  generations: 40
  seed: 1
  interpolator: fly

record:
  rate: 500 Hz                  # the controller's sampling rate
  cycles: {cycles}                   # of the loop; a hundred averages well, ten is a quick look

estimate:
  filter: {{order: 8, cutoff: 30 Hz}}
  method: weighted              # least squares weighted by each axis's noise; auto tries others on held-out data

validate:                       # random motions in the sub-region that judge the model
  motions: 30
  speed: 0.1 m/s
  seed: 2

gate:
  normalised_rmse: 3 %          # of the nominal torque, on every axis; above it the result is rejected

recalibrate:
  every: 7 d
  parameters: friction          # or all
"""


def template(
    robot: str = "comau_ns16",
    address: str = "127.0.0.1:9100",
    driver: str = "tcp",
    count: int = 6,
    centre: Sequence[str] = ("1.0 m", "0 m", "0.8 m"),
    size: Sequence[str] = ("500 mm", "600 mm", "400 mm"),
    orientation: Sequence[str] = ("0 deg", "180 deg", "0 deg"),
    cone: str = "30 deg",
    cycles: int = 100,
) -> str:
    """Text of a commented recipe that `load_recipe` reads. Quantities are texts with units, as in the file."""
    return _TEMPLATE.format(
        robot=_scalar(robot),
        driver=_scalar(driver),
        address=_scalar(address),
        count=count,
        centre=", ".join(centre),
        size=", ".join(size),
        orientation=", ".join(orientation),
        cone=cone,
        cycles=cycles,
    )


def _scalar(text: str) -> str:
    """A YAML scalar: bare where it cannot be taken for anything else, else quoted and escaped."""
    if _BARE.fullmatch(text) and text.lower() not in ("true", "false", "null", "yes", "no", "on", "off"):
        return text
    return '"' + "".join(c if " " <= c <= "~" and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'
