"""Nodes of a ROS graph, each in its own process under ROS' Python."""
