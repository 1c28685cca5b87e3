"""What the robot receives: commands, messages of other robots and the operator's settings. It uses lanes."""
