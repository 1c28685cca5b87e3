"""The agent that runs on the robot: from sources over batches and the spool to AWS IoT, and the live lane."""
