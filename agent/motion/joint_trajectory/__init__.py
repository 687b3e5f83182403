"""Joint trajectories of ROS 2 as a dialect: points in joint space, and how a JointTrajectoryController joins them."""
