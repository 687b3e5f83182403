"""The interpolation law of one controller, learned from its set-points, as a small file."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from agent.core import InputError, load_document
from agent.motion.fly.fly_parameters import FlyParameters
from agent.robot import RobotDescription

#: File name endings that distinguish a learned law from the name of an interpolator.
SUFFIXES = (".yaml", ".yml")


class LearnedLaw(BaseModel):
    """The content of a law's file: its parameters, how well they fit, and the logs they come from.

    `settling_s` [s] by `$TERM_TYPE`: time of a stop after its last set-point. `figures`: path error [mm] and time error
    [%], `before` and `after`. `logs`: name and SHA-256 of each.
    """

    model_config = ConfigDict(extra="forbid")

    schema_: Literal["interpolator/1"] = Field(alias="schema")
    robot: str
    robot_digest: str
    parameters: FlyParameters
    settling_s: dict[str, float] = {}
    figures: dict[str, dict[str, float]] = {}
    logs: list[dict[str, str]] = []

    def text(self) -> str:
        """The file's content."""
        import io

        from ruamel.yaml import YAML

        out = io.StringIO()
        yaml = YAML()
        yaml.default_flow_style = False
        yaml.dump(self.model_dump(by_alias=True), out)
        return f"# Written by agent learn-interpolator, for search.interpolator of a recipe.\n{out.getvalue()}"


def load_law(path: Path, robot: RobotDescription) -> LearnedLaw:
    """The law of a file, for this robot.

    Raises:
        InputError: no such file, another schema, values out of range, another robot, or other limits of it.
    """
    document = load_document(path, LearnedLaw)
    if document.robot != robot.name:
        raise InputError(f"{path}: was learned from {document.robot}, and the robot is {robot.name}; learn it anew")
    if document.robot_digest != robot_digest(robot):
        raise InputError(
            f"{path}: was learned with other limits of {robot.name} than its robot.yaml has now; learn it anew"
        )
    return document


def is_file_name(interpolator: str) -> bool:
    """Whether the name of an interpolator is the file of a learned law."""
    return interpolator.lower().endswith(SUFFIXES)


def robot_digest(robot: RobotDescription) -> str:
    """SHA-256 (hex) of what a law depends on: the joints, their limits and the tool's limits."""
    limits = robot.cartesian_limits
    parts: list[Any] = [
        [joint.name, joint.max_velocity, joint.max_acceleration, joint.max_jerk] for joint in robot.joints
    ]
    text = json.dumps([robot.name, parts, None if limits is None else asdict(limits)])
    return hashlib.sha256(text.encode("utf-8")).hexdigest()
