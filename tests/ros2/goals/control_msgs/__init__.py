"""Types of control_msgs 5.8 (Jazzy) for tests with unmodified rclpy, where the package itself is not there.

No wheel has it, and rclpy takes compiled types alone. So a goal travels inside types that every ROS 2 has: its request
and its answers are those of a parameter service, and what rclpy's action client and server do with them is the real
thing. The bytes on the wire are not those of control_msgs, so both ends have to be of these types.
"""
