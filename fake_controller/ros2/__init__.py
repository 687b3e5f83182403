"""A trajectory controller and a joint state broadcaster of ROS 2 over the plant; only `node` needs rclpy."""
