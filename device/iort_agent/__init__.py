"""The agent that runs on the robot: sources -> batches -> spool -> AWS IoT, and the live lane beside."""
