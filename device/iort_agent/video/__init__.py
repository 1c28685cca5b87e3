"""Video for driving by sight: a camera's pictures, their numbers, and one encoder for all viewers.

The camera's pictures become `Frame`, with a number and a capture time each. The encoder makes `Encoded` of
them, and every viewer gets the same bytes. Importing this room needs neither PyAV nor Pillow."""

from __future__ import annotations

import importlib
import math
import threading
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, NamedTuple

from iort_agent.errors import VideoError

if TYPE_CHECKING:
    import av

EXTRA = "iort-agent[video]"
# The clock of video in RTP, and of a picture's ``pts``.
RTP_HZ = 90_000
# The pictures whose capture times are kept. Whoever saw an older one saw nothing that matters.
KEPT_S = 10.0


class Frame(NamedTuple):
    """A captured picture. ``number`` counts in a run of the agent; ``captured_us`` is its capture time
    by the robot's clock, ``monotonic`` the same by the monotonic one, in seconds. ``picture`` is yuv420p of
    the configured size, and its ``pts`` counts at `RTP_HZ`. ``jpeg`` is what the camera gave, if it gives
    JPEGs, in its own size."""

    number: int
    captured_us: int
    monotonic: float
    picture: av.VideoFrame
    jpeg: bytes | None = None


class Encoded(NamedTuple):
    """A frame as VP8, or as H.264 with start codes. ``key``: a viewer can begin with it. ``encode_ms`` is how
    long the encoder took."""

    frame: Frame
    data: bytes
    key: bool
    encode_ms: float


class Pictures:
    """When the newest pictures were captured, by their numbers. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._captured: OrderedDict[int, float] = OrderedDict()

    def add(self, frame: Frame) -> None:
        """Remember a picture."""
        with self._lock:
            self._captured[frame.number] = frame.monotonic
            while frame.monotonic - next(iter(self._captured.values())) > KEPT_S:
                self._captured.popitem(last=False)

    def age_ms(self, number: int, now: float) -> float | None:
        """The age of a picture at the monotonic time ``now``; infinite for one before those that are kept,
        None for one that was never captured."""
        with self._lock:
            captured = self._captured.get(number)
            if captured is not None:
                return (now - captured) * 1000
            return math.inf if 1 <= number < next(iter(self._captured), 0) else None


def first_number(run: str) -> int:
    """The number of the first picture of a run of the agent: from 1 to 2 ** 31, by the run's name in hex.

    A program that still names a picture of the former run must not name one that is fresh in this one. The
    pictures of ten seconds of two runs have a number in common once in a million times. The other half of the
    32 bits lasts for more than a year of pictures.
    """
    return 1 + (int(run[:8], 16) >> 1)


def require(name: str) -> Any:
    """A module that video needs. Raises `VideoError`, which says what to install."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        package = {"PIL": "pillow"}.get(name.partition(".")[0], name)
        raise VideoError(f"video needs the package {package}: pip install '{EXTRA}' ({error})") from error
