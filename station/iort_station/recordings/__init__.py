"""Recordings for other tools, and batches of other tables."""
