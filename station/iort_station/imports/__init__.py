"""Imports recordings as if the robot had driven: planned, cut into the agent's batches, and written into the
table or straight into the archive. It is noted by the content, so that nothing comes twice."""
