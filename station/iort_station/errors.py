"""What can go wrong at the operator's station: every error it raises on purpose is one of these."""


class StationError(Exception):
    """The station cannot do what was asked; the text says why and, where it can, what helps."""
