"""A simulated car: its track, its driver, its physics, and its ROS graph for commands."""
