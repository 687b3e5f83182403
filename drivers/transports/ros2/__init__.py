"""The driver for arms with a JointTrajectoryController of ROS 2; rclpy is imported when a link is opened."""
