"""pyserial, and what the errors of a port mean."""

from __future__ import annotations

import errno

from iort_agent.errors import SourceError


class Library:
    """pyserial, and the errors of a port that is not there, goes away or misbehaves."""

    def __init__(self) -> None:
        import termios  # noqa: PLC0415 - only where there is a port

        import serial  # noqa: PLC0415 - optional

        self.Serial = serial.Serial
        self.errors = (OSError, termios.error)


def load_pyserial() -> Library:
    """The library. Raises `SourceError` if it is not installed."""
    try:
        # Only a robot that reads its VESC by itself needs it: pip install iort-agent[serial].
        return Library()
    except ImportError as error:
        raise SourceError(
            "reading a VESC needs the package pyserial: pip install 'iort-agent[serial]'"
        ) from error


def why(error: Exception, *, was_open: bool) -> str:
    """The operating system's error, in words that help."""
    # pyserial keeps the number of some errors, and only chains others.
    numbers = {first for e in (error, error.__context__) if e is not None for first in e.args[:1]}
    if numbers & {errno.ENOENT, errno.ENODEV, errno.ENXIO}:
        return "is not there: waiting for it to be plugged in"
    if numbers & {errno.EACCES, errno.EPERM}:
        return "may not be opened: add the user to its group, mostly `sudo usermod -aG dialout $USER`"
    if numbers & {errno.EBUSY, errno.EAGAIN}:
        return "is in use by another program, perhaps the ROS driver of the VESC"
    if errno.ENOTTY in numbers:
        return "is no serial port"
    return f"went away: {error}" if was_open else f"cannot be opened: {error}"
