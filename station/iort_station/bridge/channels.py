"""Foxglove's protocol, served by its own sdk: channels, who subscribes to them, and their messages.

The sdk listens on an address of this machine that nobody else knows; clients come through `bridge.door`. Each
client has a queue of its own: if it is full, that client loses the oldest message, and nobody else.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import foxglove
from foxglove.websocket import (
    Capability,
    ChannelView,
    Client,
    PlaybackControlRequest,
    PlaybackState,
    ServerListener,
    StatusLevel,
    WebSocketServer,
)
from typing_extensions import Self

# Messages that wait for a slow client, and their bytes.
MOST_WAITING, _LEAST_WAITING, _WAITING_BYTES = 4096, 64, 128 * 1024 * 1024
Level = Literal["info", "warning", "error"]
_LEVELS = {"info": StatusLevel.Info, "warning": StatusLevel.Warning, "error": StatusLevel.Error}


class Topic(NamedTuple):
    """A channel: its name for clients, the encoding of its messages, and their schema."""

    name: str
    encoding: str
    schema: str
    schema_encoding: str
    definition: bytes


class Message(NamedTuple):
    """A message of a topic, by the topic's number; the time is in nanoseconds since the epoch."""

    t_ns: int
    topic: int
    data: bytes


def waiting(largest_bytes: int) -> int:
    """How many messages may wait for a client if the largest has this size."""
    return max(_LEAST_WAITING, min(MOST_WAITING, _WAITING_BYTES // max(1, largest_bytes)))


class Channels:
    """Serves topics within a ``with`` block. Topics are numbered in the order in which they were added.

    ``on_wanted`` is called with a topic that a client has subscribed to, or does so no longer; ``on_control``
    for a request to play, pause or seek. Both run in a thread of the sdk, so they must not wait. ``range_ns``
    is the begin and the end of what can be played; None is live. ``publishes`` are the encodings in which
    clients may publish; what they publish stays in the door.
    """

    def __init__(
        self,
        name: str,
        *,
        topics: Sequence[Topic] = (),
        range_ns: tuple[int, int] | None = None,
        publishes: Sequence[str] = (),
        backlog: int = MOST_WAITING,
    ) -> None:
        self.name, self._range_ns, self._publishes, self._backlog = name, range_ns, publishes, backlog
        self.on_wanted: Callable[[int], None] = lambda _topic: None
        self.on_control: Callable[[PlaybackControlRequest], PlaybackState] | None = None
        self._context = foxglove.Context()
        self._lock = threading.Lock()
        self._channels: list[foxglove.Channel] = []
        self._numbers: dict[int, int] = {}
        self._subscribers: Counter[int] = Counter()
        self._server: WebSocketServer
        self.host, self.port = "", 0
        for topic in topics:
            self.add(topic)

    def __enter__(self) -> Self:
        # A client's mistake is told to the client, and must not fill the terminal.
        log = logging.getLogger("foxglove")
        self._level = log.level
        log.setLevel(logging.CRITICAL)
        capabilities = [Capability.ClientPublish] if self._publishes else []
        if self._range_ns is not None:
            capabilities += [Capability.PlaybackControl, Capability.Time]
        # A page of the internet in this machine's browser cannot try so many addresses.
        for self.host in (_hidden_host(), "127.0.0.1"):
            try:
                self._server = foxglove.start_server(
                    name=self.name,
                    host=self.host,
                    port=0,
                    capabilities=capabilities,
                    server_listener=_Listener(self),
                    supported_encodings=list(self._publishes) or None,
                    context=self._context,
                    playback_time_range=self._range_ns,
                    message_backlog_size=self._backlog,
                )
                break
            except (OSError, RuntimeError):
                if self.host == "127.0.0.1":
                    raise
        self.port = self._server.port
        return self

    def __exit__(self, *_error: object) -> None:
        self._server.stop()
        logging.getLogger("foxglove").setLevel(self._level)

    def add(self, topic: Topic) -> int:
        """Advertise a topic, also while clients are connected; returns its number."""
        channel = foxglove.Channel(
            topic.name,
            schema=foxglove.Schema(name=topic.schema, encoding=topic.schema_encoding, data=topic.definition),
            message_encoding=topic.encoding,
            context=self._context,
        )
        with self._lock:
            self._channels.append(channel)
            self._numbers[channel.id()] = len(self._channels) - 1
            return len(self._channels) - 1

    def wanted(self) -> frozenset[int]:
        """The topics that somebody subscribes to."""
        with self._lock:
            return frozenset(+self._subscribers)

    def subscribers(self, topic: int) -> int:
        """How many subscribe to a topic."""
        with self._lock:
            return self._subscribers[topic]

    def send(self, message: Message) -> None:
        """Send a message to who subscribes to its topic."""
        self._channels[message.topic].log(message.data, log_time=message.t_ns)

    def tell_time(self, t_ns: int) -> None:
        """Tell every client what time it is."""
        self._server.broadcast_time(t_ns)

    def tell_state(self, state: PlaybackState) -> None:
        """Tell every client how playback stands."""
        self._server.broadcast_playback_state(state)

    def say(self, text: str, level: Level = "warning", *, name: str | None = None) -> None:
        """Show a line to every client; a later one of the same ``name`` takes its place."""
        self._server.publish_status(text, _LEVELS[level], name)

    def unsay(self, name: str) -> None:
        """Take a line back."""
        self._server.remove_status([name])

    # Called in threads of the sdk.

    def _subscribed(self, channel: int, more: int) -> None:
        with self._lock:
            number = self._numbers[channel]
            self._subscribers[number] += more
        self.on_wanted(number)

    def _control(self, request: PlaybackControlRequest) -> PlaybackState | None:
        return None if self.on_control is None else self.on_control(request)


class _Listener(ServerListener):
    def __init__(self, channels: Channels) -> None:
        self._channels = channels

    def on_subscribe(self, _client: Client, channel: ChannelView) -> None:
        self._channels._subscribed(channel.id, 1)  # noqa: SLF001 - a part of it

    def on_unsubscribe(self, _client: Client, channel: ChannelView) -> None:
        self._channels._subscribed(channel.id, -1)  # noqa: SLF001 - a part of it

    def on_playback_control_request(self, request: PlaybackControlRequest) -> PlaybackState | None:
        return self._channels._control(request)  # noqa: SLF001 - a part of it


def _hidden_host() -> str:
    """An address of the loopback at random; Linux answers to each, macOS to the first alone."""
    return f"127.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}.{secrets.randbelow(254) + 1}"
