"""The root of all errors that the bench raises on purpose."""


class BenchError(Exception):
    """A measurement failed; the text says which one."""
