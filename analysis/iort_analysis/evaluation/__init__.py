"""The evaluation: what differs from the robot's own earlier drives, or from the fleet's."""
