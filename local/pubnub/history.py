"""The messages that PubNub's stand-in keeps, and the selection of a subscription."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import NamedTuple

# Limits of the messages kept for subscribers that are away, and so of the memory.
KEPT_A_CHANNEL = 100
KEPT_CHANNELS = 1_000
KEPT_BYTES = 64 * 1024 * 1024
MESSAGES_AN_ANSWER = 100


class Message(NamedTuple):
    """One published message; the payload is the JSON text as sent."""

    token: int
    channel: str
    publisher: str
    payload: str


class Subscription:
    """The channels of a request: plain names, and wildcards by their prefixes."""

    def __init__(self, channels: list[str]) -> None:
        self.names = {name for name in channels if not name.endswith(".*")}
        self._prefixes = {name[:-1]: name for name in channels if name.endswith(".*")}

    def match(self, channel: str) -> str | None:
        """The entry of the subscription that the channel matches; a plain name comes first."""
        if channel in self.names:
            return channel
        for prefix, wildcard in self._prefixes.items():
            if channel.startswith(prefix):
                return wildcard
        return None


class History:
    """The newest messages of each channel, within limits of messages, channels and bytes."""

    def __init__(self, *, channels: int = KEPT_CHANNELS, size_bytes: int = KEPT_BYTES) -> None:
        self._most_channels, self._most_bytes = channels, size_bytes
        self._channels: OrderedDict[str, deque[Message]] = OrderedDict()
        self._bytes = 0

    def add(self, message: Message) -> None:
        """Keep the message. At a limit the channel that was silent for longest is dropped."""
        kept = self._channels.setdefault(message.channel, deque())
        self._channels.move_to_end(message.channel)
        kept.append(message)
        self._bytes += len(message.payload)
        if len(kept) > KEPT_A_CHANNEL:
            self._bytes -= len(kept.popleft().payload)
        while len(self._channels) > self._most_channels or (
            self._bytes > self._most_bytes and len(self._channels) > 1
        ):
            _, dropped = self._channels.popitem(last=False)
            self._bytes -= sum(len(old.payload) for old in dropped)

    def after(self, cursor: int, wanted: Subscription) -> list[tuple[str, Message]]:
        """The oldest messages after the cursor, at most those of one answer, each with its match."""
        found: list[tuple[str, Message]] = []
        for channel, kept in self._channels.items():
            match = wanted.match(channel)
            if match is not None and kept[-1].token > cursor:
                found.extend((match, message) for message in kept if message.token > cursor)
        found.sort(key=lambda entry: entry[1].token)
        return found[:MESSAGES_AN_ANSWER]
