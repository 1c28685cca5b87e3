"""What operators and robots tell a robot to do: commands, driving, and settings by the shadow."""
