"""What the robot is told: commands, other robots' messages and the operator's settings."""
