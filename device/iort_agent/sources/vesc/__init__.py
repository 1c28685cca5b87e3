"""A VESC motor controller on its serial line: the protocol, and the source that polls it."""
