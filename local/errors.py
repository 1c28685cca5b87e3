"""The error that the embedded cloud raises on purpose."""


class LocalError(Exception):
    """The embedded cloud cannot do what was asked. The text says why and what to do."""
