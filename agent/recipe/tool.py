"""The tool of a recipe, as robot dynamics has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from agent.motion import pose_of
from agent.recipe.schema import ToolSection

if TYPE_CHECKING:
    from agent.robot import Tool


def tool_of(section: ToolSection | None) -> Tool | None:
    """The tool, or None where the recipe has none."""
    if section is None:
        return None
    from agent.robot import Tool

    frame = pose_of(section.frame)
    # The recipe's centre of mass is in the flange's frame, as on a controller's panel; `Tool` has it in the TCP's.
    flange = np.zeros(3) if section.centre_of_mass is None else np.array(section.centre_of_mass)
    return Tool(frame=frame, mass=section.mass, centre_of_mass=frame[:3, :3].T @ (flange - frame[:3, 3]))
