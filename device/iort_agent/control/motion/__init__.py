"""Commands to ROS topics: which may pass, who drives, and what stops the robot in time."""
