"""The errors that the embedded cloud raises on purpose."""


class LocalError(Exception):
    """The embedded cloud cannot do what was asked. The text says why and what to do."""


class EmulatorError(LocalError):
    """The emulator ended, and nobody has stopped it; errors of its clients come from this."""
