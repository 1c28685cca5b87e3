"""The functions as AWS runs them: its own runtime interface client, a Runtime API, the layer, the logs."""
