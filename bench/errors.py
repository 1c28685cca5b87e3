"""What can go wrong in a measurement: every error that the bench raises on purpose is one of these."""


class BenchError(Exception):
    """Something could not be measured; the text says what."""
