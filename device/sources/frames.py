"""Whose frame a topic's headers are in, said when it is first known and whenever it is another.

An export makes the headers again of it. As a field of every sample it would be the same text for years.
"""

from __future__ import annotations

import logging
from typing import Mapping

from contract import FrameId, Value

_log = logging.getLogger(__name__)

_MAX_TEXT = 4096
# Of a topic whose frame is another with every message, nothing is better than something wrong.
MAX_CHANGES = 32


class Frames:
    """What has been said of one topic's frame in this run."""

    def __init__(self, stream: str, topic: str) -> None:
        self._stream = stream
        self._topic = topic
        self._said: str | None = None
        self._times = 0

    def sample(self, frame: str, t_us: int) -> Mapping[str, Value] | None:
        """The sample of the stream `TYPES_STREAM` that says so; None where it is said already.

        After `MAX_CHANGES` it says once that the frame is not known, and then nothing.
        """
        if frame == self._said or self._times > MAX_CHANGES:
            return None
        self._times += 1
        self._said = frame
        if len(frame) > _MAX_TEXT:
            frame = ""
        if self._times > MAX_CHANGES:
            _log.warning("topic %s: its frame_id keeps changing and is not recorded any more", self._topic)
            frame = ""
        return FrameId(self._stream, self._topic, frame, t_us).sample()
