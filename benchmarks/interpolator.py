"""CPU time of the FLY interpolator on random 6-point loops in a box, inverse kinematics included.

    python benchmarks/interpolator.py

Takes one core; process times. The same loops are run at several speeds, to see how the cost grows with samples.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

LOOPS, REPEATS = 60, 5


def main() -> None:
    """Print the table."""
    from agent.motion import FlyInterpolator, MotionError, ViaRegions, loop_moves
    from agent.motion.program import FlyTrajectory, FlyType, MotionSettings
    from agent.robot import load_robot
    from agent.robot.kinematics import KinematicsError, kinematics_for

    robot = load_robot("comau_ns16")
    kinematics, interpolator = kinematics_for(robot), FlyInterpolator(robot)
    box = ViaRegions.from_box(6, [1.0, 0.0, 0.8], [0.5, 0.6, 0.4], [0.0, np.pi, 0.0], np.radians(30))
    posture = np.array([0.0, 0.0, -np.pi / 2, 0.0, np.pi / 3, 0.0])
    settings = MotionSettings(fly_type=FlyType.FLY_CART, fly_trajectory=FlyTrajectory.FLY_TOL, fly_distance=0.02)
    rng = np.random.default_rng(0)
    print("speed m/s   loops   seconds   samples   ms a loop   ms per 5000 samples   slowest of the loops, ms")
    points = []
    for speed in (1.0, 0.5, 0.25, 0.1):
        samples, costs = [], []
        for genome in rng.random((LOOPS, 36)):
            poses = box.poses(genome)
            moves = loop_moves(poses, settings.changed(linear_speed=speed))
            try:
                start = kinematics.solve(poses[0], posture)
                trajectory = interpolator.plan(moves, start)
            except (MotionError, KinematicsError):
                continue
            begin = time.process_time()
            for _ in range(REPEATS):
                interpolator.plan(moves, start)
            costs.append(1e3 * (time.process_time() - begin) / REPEATS)
            samples.append(len(trajectory.t))
        mean, cost = np.mean(samples), np.mean(costs)
        points.append((mean, cost))
        print(
            f"{speed:9.2f} {len(costs):7d} {mean * interpolator.period:9.1f} {mean:9.0f} {cost:11.1f} "
            f"{5000 * cost / mean:21.1f} {np.max(costs):26.1f}"
        )
    counts, times = np.array(points).T
    slope, fixed = np.polyfit(counts, times, 1)
    print(f"linear fit: {fixed:.1f} ms a loop and {1e3 * slope:.2f} ms per 1000 samples")


if __name__ == "__main__":
    main()
