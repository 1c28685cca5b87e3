"""Runs the functions as AWS does: its runtime interface client, a Runtime API, the layer, the logs."""
