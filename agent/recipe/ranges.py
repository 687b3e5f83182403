"""Whether the ranges of all joints are known: a recipe is what arms are moved by, a log needs no limits to be read."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator

import numpy as np

from agent.robot import RobotDescription

#: No joint with stops goes farther from its zero [rad]. The widest wrists turn seven times and a half to either side,
#: and a description in degrees has a joint that goes to 63 or more.
FARTHEST = 20 * np.pi


def range_faults(robot: RobotDescription, narrowed: Collection[str]) -> Iterator[str]:
    """What keeps a motion from being judged by the joints' ranges: those that are missing, or look like degrees.

    Args:
        robot: its ranges are those of its URDF [rad, m].
        narrowed: names of joints whose range is given elsewhere.
    """
    asked = [joint for joint in robot.joints if joint.name not in narrowed]
    elements = {e.get("name"): e for e in ElementTree.fromstring(robot.urdf).findall("joint")}
    for joint in asked:
        kind = elements[joint.name].get("type")
        missing = [end for end in ("lower", "upper") if np.isinf(getattr(joint, end))]
        if missing and kind != "continuous":
            yield (
                f"joint {joint.name!r} is {kind}, and its URDF gives it no {' and no '.join(missing)} limit, so that "
                "nothing would keep a motion from its stops: put <limit lower=... upper=...> into the URDF "
                f"({'m' if joint.prismatic else 'rad'}) or a range into cell.joint_ranges"
                f"{'' if joint.prismatic else '; a joint that turns without end is continuous'}"
            )
    far = [joint for joint in asked if not joint.prismatic and FARTHEST < max(-joint.lower, joint.upper) < np.inf]
    if far:
        yield (
            f"joint {far[0].name!r}{f' and {len(far) - 1} more' if far[1:] else ''}: a range of {far[0].lower:g} to "
            f"{far[0].upper:g} rad, more than ten turns from zero, looks like degrees; a URDF has radians. Where it is "
            "meant so, say in cell.joint_ranges how far the joint may go, or make it continuous"
        )
