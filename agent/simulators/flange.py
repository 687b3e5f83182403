"""The frame in which a vendor enters a load: the flange of the controller.

| frame | why |
| --- | --- |
| named by the caller | by `--flange` |
| `tip_frame` of the robot | where it is not the link that the last joint moves |
| `tool0` | by the convention of ROS-Industrial, the flange as the controller has it |
| another usual name of a flange | where all frames with such names coincide |
| the last moving link | where no frame has a usual name |

Only frames that fixed joints hold beyond the last joint count.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

import numpy as np

from agent.core import InputError, and_list
from agent.robot import Dynamics, RobotDescription
from agent.simulators.urdf import end_of, moved_links

#: Usual names, with any prefix: `link8` is the flange of Franka's arms, `attachment_site` of MuJoCo Menagerie's.
_CONTROLLERS_OWN = re.compile(r"(^|.*[_./-])tool0$", re.IGNORECASE)
_USUAL = re.compile(
    r"(^|.*[_./-])(tool0|(tool_|robot_)?flange|ee|ee_link|link_ee|link_eef|eef|end_effector(_link)?|attachment_site|link8)$",
    re.IGNORECASE,
)
_SAME = 1e-4  # rad and m: a tenth of a millimetre, the finest step that vendors' fields have


class Flange(NamedTuple):
    """A frame, its pose (4, 4) in the last link, and how it was chosen."""

    frame: str
    pose: np.ndarray
    chosen: str


def flange_of(robot: RobotDescription, wanted: str | None = None) -> Flange:
    """The flange of a robot; `wanted` names it.

    Raises:
        InputError: no such frame beyond the last joint, or several that may be meant.
    """
    last, beyond = moved_links(robot)[-1], _fixed_beyond(robot)
    dynamics, zero = Dynamics(robot), np.zeros((1, robot.dof))
    link = dynamics.link_poses(zero, last)[0]

    def flange(frame: str, chosen: str) -> Flange:
        pose = dynamics.tip_pose(zero)[0] if frame == robot.tip_frame else dynamics.link_poses(zero, frame)[0]
        return Flange(frame, np.linalg.solve(link, pose), chosen)

    if wanted is not None:
        if wanted not in (last, robot.tip_frame, *beyond):
            listed = ", ".join(dict.fromkeys([last, robot.tip_frame, *beyond]))
            raise InputError(f"--flange {wanted}: no frame fixed to the last link of {robot.name}; it has {listed}")
        return flange(wanted, "as named by --flange")
    if robot.tip_frame != last:
        return flange(robot.tip_frame, "the robot's tip_frame")
    named = [frame for frame in beyond if _USUAL.match(frame)]
    likely = [flange(frame, f"the usual name of a flange beyond {last}") for frame in named]
    likely = [each for each in likely if _CONTROLLERS_OWN.match(each.frame)] or likely
    if any(np.abs(each.pose - likely[0].pose).max() > _SAME for each in likely):
        listed = and_list([each.frame for each in likely])
        raise InputError(
            f"{listed} of {robot.name} lie in different places, and each may be the flange: name the controller's "
            f"with --flange {likely[0].frame}, or as tip_frame in robot.yaml"
        )
    return likely[0] if likely else flange(last, "the last moving link, as no frame beyond it is called like a flange")


def _fixed_beyond(robot: RobotDescription) -> list[str]:
    """Links that fixed joints hold to the link of the last joint, nearest first."""
    children: dict[str, list[str]] = {}
    for joint in ElementTree.fromstring(robot.urdf).findall("joint"):
        if joint.get("type") == "fixed":
            children.setdefault(end_of(joint, "parent"), []).append(end_of(joint, "child"))
    frames = [moved_links(robot)[-1]]
    for frame in frames:
        frames += [child for child in children.get(frame, ()) if child not in frames]
    return frames[1:]
