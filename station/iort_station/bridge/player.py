"""Plays what is stored: one playhead for every client, as the protocol has it.

            control(play)                        the end
    paused ---------------> playing <--> buffering -----> ended
       ^  <---------------     |                            |
       |    control(pause)     +------ nothing read yet     |
       +------------------- control(seek) ------------------+

A reader reads ahead from the playhead, in a thread of its own, what clients subscribe to. A seek and another
subscription cancel what it reads; of several seeks it reads the last one. Each message is sent once between
two seeks, when the playhead has passed it. While paused, the first message of each topic is sent before its
time, so that a panel shows something.

What waits in a client's queue at a seek follows the state that tells the seek: the sdk has one queue for
states and one for messages, and takes from both.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing
from typing import Protocol

from botocore.exceptions import BotoCoreError, ClientError
from foxglove.websocket import PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus
from typing_extensions import Self

from iort_station.bridge.channels import Level, Message
from iort_station.bridge.stored import Cancelled, Source
from iort_station.errors import StationError
from iort_station.supervision import keep

_log = logging.getLogger("iort")
SLOWEST, FASTEST = 0.01, 100.0
_TICK_S = 0.02
# The reader waits while so much is read ahead.
_AHEAD_MESSAGES, _AHEAD_BYTES = 4096, 64 * 1024 * 1024
# No more messages at once: a client's queue must hold them.
_AT_ONCE = 512
# A pause of reading that clients are told of.
_BUFFERING_S = 0.25
# A state overtakes messages in a client's queue, so the end is told so long after the last one.
_SETTLES_S = 0.25
# What is sent before its time while paused comes at most so long after the playhead.
_SHOWN_NS = 1_000_000_000
# Clients are told the time so often.
_TIME_S = 1 / 30
_PROBLEM = "reading"
# Without a network a request takes minutes to fail: Ctrl-C does not wait for it.
_GOODBYE_S = 3.0


class Audience(Protocol):
    """Who sees what is played."""

    def wanted(self) -> frozenset[int]:
        """The topics that somebody subscribes to."""

    def send(self, message: Message) -> None:
        """Take a message."""

    def tell_time(self, t_ns: int) -> None:
        """Take the playhead's time."""

    def tell_state(self, state: PlaybackState) -> None:
        """Take a change of the state."""

    def say(self, text: str, level: Level = "warning", *, name: str | None = None) -> None:
        """Take a line for people."""

    def unsay(self, name: str) -> None:
        """Take a line back."""


class Player:
    """Plays a source to an audience within a ``with`` block, in two threads of its own."""

    def __init__(
        self, source: Source, audience: Audience, monotonic: Callable[[], float] = time.monotonic
    ) -> None:
        self._source, self._audience, self._monotonic = source, audience, monotonic
        self._changed = threading.Condition()
        self._end = threading.Event()
        self._status, self._speed = PlaybackStatus.Paused, 1.0
        # Where the playhead was, and when.
        self._at_ns, self._at_s = source.start_ns, 0.0
        # What is read ahead, which is complete before `_read_ns`.
        self._ahead: deque[Message] = deque()
        self._ahead_bytes = 0
        self._read_ns = source.start_ns
        # Each reading has a number: another one cancels it. The reader's own is the newest that it has taken.
        self._reading = self._taken = 0
        # Whether the last reading failed, and whether clients still show that.
        self._has_failed = self._said = False
        self._subscribed: frozenset[int] = frozenset()
        # What was sent before its time, by topic.
        self._shown: dict[int, int] = {}
        self._starved_s: float | None = None
        self._told_s = self._sent_s = 0.0
        # How often clients controlled it, and how often they sought.
        self._orders = self._seeks = 0
        # Somebody has just come, and does not know the state.
        self._tells = False
        self._threads = [
            threading.Thread(target=keep, args=(name, work, self._end), name=name, daemon=True)
            for name, work in (("bridge's reader", self._read), ("bridge's player", self._play))
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        with self._changed:
            self._end.set()
            self._reading += 1
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(_GOODBYE_S)

    # Called in threads of the sdk, which must not wait.

    def control(self, request: PlaybackControlRequest) -> PlaybackState:
        """Play, pause or seek, at another speed; returns the state that this begins."""
        with self._changed:
            self._advance()
            speed = request.playback_speed
            self._speed = min(max(speed, SLOWEST), FASTEST) if speed > 0 else self._speed
            self._orders += 1
            if request.seek_time is not None:
                self._at_ns = min(max(request.seek_time, self._source.start_ns), self._source.end_ns)
                self._shown.clear()
                self._seeks += 1
                self._read_from(self._at_ns)
            wants_play = request.playback_command == PlaybackCommand.Play
            ended = self._status is PlaybackStatus.Ended and request.seek_time is None
            if not ended:
                self._status = PlaybackStatus.Playing if wants_play else PlaybackStatus.Paused
            if wants_play and self._has_failed:
                self._read_again()
            self._starved_s = None
            self._changed.notify_all()
            return self._state(request.request_id, did_seek=request.seek_time is not None)

    def rewanted(self, topic: int) -> None:
        """Somebody subscribes to a topic, or does so no longer."""
        with self._changed:
            # Who has just come has not seen it.
            self._shown.pop(topic, None)
            self._tells = True
            self._changed.notify_all()

    # The playhead.

    def _advance(self) -> None:
        """Move the playhead to where it is now: as far as everything before it is read."""
        now_s = self._monotonic()
        if self._status in (PlaybackStatus.Playing, PlaybackStatus.Buffering):
            moved_ns = self._at_ns + round((now_s - self._at_s) * 1e9 * self._speed)
            read_ns = self._read_ns if self._subscribed else self._source.end_ns
            self._at_ns = max(self._at_ns, min(moved_ns, read_ns))
        self._at_s = now_s

    def _state(self, request_id: str | None = None, *, did_seek: bool = False) -> PlaybackState:
        return PlaybackState(self._status, self._at_ns, self._speed, did_seek, request_id)

    def _play(self) -> None:
        """Send what the playhead passes."""
        while not self._end.is_set():
            with self._changed:
                if (wanted := self._audience.wanted()) != self._subscribed:
                    self._subscribed = wanted
                    self._shown = {topic: t_ns for topic, t_ns in self._shown.items() if topic in wanted}
                    self._read_again()
                messages, state = self._due()
                if self._tells:
                    self._tells, state = False, self._state()
                moves = self._status is PlaybackStatus.Playing
                at_ns, now_s = self._at_ns, self._monotonic()
                orders, seeks = self._orders, self._seeks
            # Without the lock: a thread of the sdk may wait for it.
            for message in messages:
                # After a seek, nothing of the place before.
                if self._seeks != seeks:
                    break
                self._audience.send(message)
            # The answer to an order is newer.
            if self._orders != orders:
                continue
            if moves and (now_s - self._told_s >= _TIME_S or state is not None):
                self._told_s = now_s
                self._audience.tell_time(at_ns)
            if state is not None:
                self._audience.tell_state(state)
            with self._changed:
                if moves or self._status is PlaybackStatus.Buffering:
                    self._changed.wait(_TICK_S if len(messages) < _AT_ONCE else _TICK_S / 4)
                elif not self._tells and not self._unshown():
                    self._changed.wait()

    def _due(self) -> tuple[list[Message], PlaybackState | None]:
        """What is to be sent now, and the state if it has changed by itself."""
        before = self._status
        if before is PlaybackStatus.Paused:
            shown = self._unshown()
            self._shown |= {message.topic: message.t_ns for message in shown}
            return shown, None
        if before is PlaybackStatus.Ended:
            return [], None
        self._advance()
        due: list[Message] = []
        while self._ahead and (next_ns := self._ahead[0].t_ns) < self._at_ns:
            if len(due) >= _AT_ONCE and next_ns > due[-1].t_ns:
                # More than clients can take at once: the playhead waits.
                self._at_ns = next_ns
                break
            message = self._ahead.popleft()
            self._ahead_bytes -= len(message.data)
            if self._shown.get(message.topic) == message.t_ns:
                del self._shown[message.topic]
            else:
                due.append(message)
        self._changed.notify_all()
        if due:
            self._sent_s = self._at_s
        ends = self._at_ns >= self._source.end_ns
        if ends and self._at_s - self._sent_s >= _SETTLES_S:
            self._status = PlaybackStatus.Ended
        elif ends or self._at_ns < self._read_ns or not self._subscribed:
            self._starved_s, self._status = None, PlaybackStatus.Playing
        elif self._starved_s is None:
            self._starved_s = self._at_s
        elif self._at_s - self._starved_s > _BUFFERING_S:
            self._status = PlaybackStatus.Buffering
        return due, self._state() if self._status is not before else None

    def _unshown(self) -> list[Message]:
        """While paused, the first message of each topic that was not sent yet."""
        found: dict[int, Message] = {}
        if self._status is not PlaybackStatus.Paused:
            return []
        for message in self._ahead:
            every = len(found) + len(self._shown) >= len(self._subscribed)
            if every or message.t_ns >= self._at_ns + _SHOWN_NS:
                break
            if message.topic not in self._shown:
                found.setdefault(message.topic, message)
        return list(found.values())

    # The reader.

    def _read_again(self) -> None:
        """Read from the first message that was not sent."""
        if self._ahead:
            self._at_ns = min(self._at_ns, self._ahead[0].t_ns)
        self._read_from(self._at_ns)

    def _read_from(self, at_ns: int) -> None:
        """Cancel what is being read, and read from a time on."""
        self._reading += 1
        self._has_failed = False
        self._ahead.clear()
        self._ahead_bytes, self._read_ns = 0, at_ns
        self._changed.notify_all()

    def _read(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._end.is_set() or self._reading != self._taken)
                if self._end.is_set():
                    return
                self._taken = reading = self._reading
                at_ns, wanted = self._read_ns, self._subscribed
            try:
                if wanted:
                    self._read_ahead(reading, at_ns, wanted)
            except Cancelled:
                continue
            except Exception as error:  # noqa: BLE001 - told to clients, and logged
                self._failed(reading, error)

    def _read_ahead(self, reading: int, at_ns: int, wanted: frozenset[int]) -> None:
        def check() -> None:
            if self._reading != reading:
                raise Cancelled

        def say(text: str) -> None:
            self._audience.say(text, name=f"{_PROBLEM}: {text[:40]}")

        with closing(self._source.messages(at_ns, wanted, check, say)) as messages:
            for message in messages:
                with self._changed:
                    self._changed.wait_for(lambda: self._has_room() or self._reading != reading)
                    check()
                    self._ahead.append(message)
                    self._ahead_bytes += len(message.data)
                    # Others may have the same time.
                    self._read_ns = message.t_ns
                    # A player that plays looks by itself.
                    if self._status is not PlaybackStatus.Playing and message.topic not in self._shown:
                        self._changed.notify_all()
        with self._changed:
            check()
            self._read_ns = self._source.end_ns
            self._changed.notify_all()
        if self._said:
            self._said = False
            self._audience.unsay(_PROBLEM)

    def _has_room(self) -> bool:
        return not self._ahead or (len(self._ahead) < _AHEAD_MESSAGES and self._ahead_bytes < _AHEAD_BYTES)

    def _failed(self, reading: int, error: Exception) -> None:
        with self._changed:
            if self._reading != reading:
                return
            self._has_failed = self._said = True
            self._advance()
            self._status = PlaybackStatus.Paused
            state = self._state()
        expected = isinstance(error, (StationError, BotoCoreError, ClientError))
        _log.warning("what is stored cannot be read: %s", error, exc_info=not expected)
        self._audience.say(f"reading has failed, and play tries again: {error}", "error", name=_PROBLEM)
        self._audience.tell_state(state)
