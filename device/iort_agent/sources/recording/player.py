"""Plays a recording of any kind, at its own pace and with the chosen times."""

from __future__ import annotations

import threading
from typing import Callable, ContextManager, Iterator, Mapping, NamedTuple, Optional

from iort_agent.common.threads import Clock, Pace
from iort_agent.sources import Emit
from iort_contract.catalog.streams import TYPES_STREAM
from iort_contract.limits import Value

NOW, ORIGINAL = "now", "original"
# The time between the rounds of a recording with a single message.
_LONE_NS = 1_000_000_000


class Message(NamedTuple):
    """A message: the time of recording, counted from the start, and the time of measurement."""

    stream: str
    at_ns: int
    stamp_ns: int
    values: Mapping[str, Value]


# Opens the recording for one round; gives its messages in the order of recording.
Open = Callable[[], ContextManager[Iterator[Message]]]


class Playback(NamedTuple):
    """How to play: see `iort_agent.sources.recording.BagConfig`."""

    speed: float
    stamps: str
    loop: bool
    duration_s: Optional[float]  # noqa: UP045 - a NamedTuple's types are evaluated, on Python 3.8 too


def play(recording: Open, how: Playback, clock: Clock, emit: Emit, stop: threading.Event) -> None:
    """Emit the messages until the end, or for ever with ``loop``. Raises the recording's errors."""
    pace = Pace(clock, stop)
    passed_ns = 0  # recorded time of the rounds before this one
    limit_ns = None if how.duration_s is None else round(how.duration_s * 1e9)
    base_us = clock.now_us()
    while True:
        with recording() as messages:
            played, at_ns = 0, passed_ns
            for message in messages:
                at_ns = passed_ns + message.at_ns
                if limit_ns is not None and at_ns >= limit_ns:
                    return
                if not pace.until(at_ns / 1e9 / how.speed if how.speed else 0.0):
                    return
                if how.stamps == ORIGINAL:
                    t_us = (message.stamp_ns + passed_ns) // 1000
                elif how.speed:
                    t_us = base_us + round(at_ns / 1000 / how.speed)
                else:
                    t_us = clock.now_us()
                emit(message.stream, t_us, message.values)
                # A type comes with its first message, and is not a message.
                played += message.stream != TYPES_STREAM
        if not how.loop or not played:
            return
        # The next round begins one mean interval later, so that no two samples have one time.
        passed_ns = at_ns + ((at_ns - passed_ns) // (played - 1) if played > 1 else _LONE_NS)
