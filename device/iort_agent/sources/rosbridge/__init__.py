"""ROS topics over the rosbridge WebSocket protocol."""
