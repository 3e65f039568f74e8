"""The shield as a ROS 2 node: node.py has what touches rclpy, the rest is plain Python."""
