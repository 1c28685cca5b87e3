"""The connection to the broker, and what keeps it alive."""
