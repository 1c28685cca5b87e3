"""The agent's own ROS 1 node, installed message types, and ROS 1 messages from and to JSON. This room uses
the tools of all rooms, and knows neither sources nor lanes."""
