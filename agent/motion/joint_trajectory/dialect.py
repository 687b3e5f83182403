"""Joint trajectories as a dialect (`agent.motion.dialect`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agent.core import InputError
from agent.motion.joint_trajectory.interpolator import BLENDS
from agent.motion.joint_trajectory.program import TrajectoryProgram, goals_of, read_program, written
from agent.motion.path_settings import PathSettings
from agent.motion.program import LoopProgram, Statement

if TYPE_CHECKING:
    from agent.robot import RobotDescription


class JointTrajectoryDialect:
    """What a JointTrajectoryController of ROS 2 takes: one goal a motion from rest to rest."""

    name = "joint_trajectory"
    suffix = ".jsonl"
    comment = "#"
    interpolators = ("joint_trajectory",)
    fly_keys = frozenset({"distance"})
    frame_names: Mapping[str, str] = {}

    def read(self, text: str, path: str = "", robot: RobotDescription | None = None) -> TrajectoryProgram:
        """A program of goals."""
        return read_program(text, path, robot)

    def write(self, name: str, statements: Sequence[Statement], robot: RobotDescription | None = None) -> str:
        """A program that makes these moves and delays once, from a joint move on."""
        return written(name, robot, (statements, 1))

    def write_loop(self, name: str, loop: LoopProgram, robot: RobotDescription | None = None) -> str:
        """A move to the start, then one goal for the cycle, sent as often as it is run."""
        return written(name, robot, ([loop.approach], 1), (loop.moves, loop.cycles))

    def settings(self, fly: Mapping[str, Any], speed: float, robot: RobotDescription) -> PathSettings:
        """Blends that keep within the recipe's distance of their via-points."""
        return PathSettings(fly_distance=fly["distance"], linear_speed=speed).changed(**BLENDS)

    def job(
        self, text: str, path: str = "", robot: RobotDescription | None = None, companion: str = ""
    ) -> tuple[str, dict[str, int]]:
        """The program itself: nothing but motion is in it.

        Raises:
            InputError: not such a program.
        """
        read_program(text, path, robot)
        return text, {}

    def companion(self, program: Path) -> Path | None:
        """None: positions are in the program."""
        return None

    def messages(self, text: str) -> dict[str, str]:
        """Files for whoever sends the trajectories without the agent: each goal as JSON, and how it is sent."""
        files = {f"goal_{number}.json": goal for number, goal in enumerate(goals_of(text), 1)}
        if not files:
            raise InputError("this program has no trajectory to send")
        lines = [
            "# A trajectory begins where the arm has to stand: move it there first, and be ready to stop it.",
            "# Replace /joint_trajectory_controller by your controller, with its namespace.",
            *(
                "ros2 action send_goal /joint_trajectory_controller/follow_joint_trajectory "
                f'control_msgs/action/FollowJointTrajectory "$(cat {file})"'
                for file in files
            ),
        ]
        return {**files, "send_goal.txt": "".join(f"{line}\n" for line in lines)}
