"""The agent's own ROS 1 node, and ROS 1 messages from and to JSON."""
