"""What can go wrong at the operator's station: every error it raises on purpose is one of these."""


class StationError(Exception):
    """The station cannot do what was asked; the text says why and, where it can, what helps."""


class UsageError(StationError):
    """Nobody could do what was asked: a text that is no time, or options that contradict one another."""
