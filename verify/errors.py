"""The errors of this package."""


class VerifyError(Exception):
    """The root of this package's errors."""


class CannotAskError(VerifyError):
    """A question cannot be asked here; the text says why."""
