"""Nodes of a ROS 2 graph, each in its own process under a Python that has rclpy."""
