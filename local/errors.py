"""What can go wrong with the embedded cloud: every error it raises on purpose is one of these."""


class LocalError(Exception):
    """The embedded cloud cannot do what was asked; the text says why and what to do."""
