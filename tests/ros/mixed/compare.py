"""Compares two bags message by message: `python -m tests.ros.mixed.compare RECORDED.bag EXPORTED.bag`.

By topic, it prints the serialized messages of only one bag, and the first field that differs.
"""

# ruff: noqa: T201 - a command prints for its user

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from rosbags.rosbag1 import Reader

from testkit.ros1_types import Message, fields


class Recorded(NamedTuple):
    """A message in a bag: ``node`` published it, and it was recorded at ``t_ns``."""

    topic: str
    node: str
    t_ns: int
    data: bytes


class Kind(NamedTuple):
    """A topic's type: package/Type, checksum, definition."""

    name: str
    md5sum: str
    definition: str

    def message(self) -> Message:
        """Return a reader of the type's messages."""
        own, *others = self.definition.split("=" * 80 + "\n")
        texts = dict(other.removeprefix("MSG: ").split("\n", 1) for other in others)
        return Message(self.name, {**{name: text.strip() for name, text in texts.items()}, self.name: own})


class Bag(NamedTuple):
    """The contents of a bag, in order of time."""

    kinds: dict[str, Kind]
    messages: list[Recorded]

    def of(self, topic: str) -> list[Recorded]:
        """Return a topic's messages."""
        return [one for one in self.messages if one.topic == topic]


def read(*paths: Path) -> Bag:
    """Read the bags as one."""
    found: list[Recorded] = []
    kinds: dict[str, Kind] = {}
    for path in paths:
        with Reader(path) as reader:
            for c in reader.connections:
                name = c.msgtype.replace("/msg/", "/")
                kinds[c.topic] = Kind(name, c.digest, str(c.msgdef.data))
            for connection, t_ns, raw in reader.messages():
                topic = connection.topic
                node = str(getattr(connection.ext, "callerid", None) or "")
                found.append(Recorded(topic, node.lstrip("/"), t_ns, bytes(raw)))
    return Bag(kinds, found)


class Difference(NamedTuple):
    """A topic's difference: recorded but not exported, exported but not recorded, and an example of either
    in words.
    """

    topic: str
    recorded: int
    missing: list[Recorded]
    extra: list[Recorded]
    first: str

    def __str__(self) -> str:
        counted = f"{len(self.missing):,} of {self.recorded:,} missing, {len(self.extra):,} others"
        return f"{self.topic}: {counted}; {self.first}"


def compare(recorded: Bag, exported: Bag) -> list[Difference]:
    """Return the topics that differ, as multisets."""
    found = []
    for topic, kind in recorded.kinds.items():
        sent, came = recorded.of(topic), exported.of(topic)
        missing = _beyond(sent, Counter(one.data for one in came))
        extra = _beyond(came, Counter(one.data for one in sent))
        if missing or extra:
            found.append(Difference(topic, len(sent), missing, extra, _words(kind, missing, extra)))
        elif came and kind[:2] != exported.kinds[topic][:2]:
            found.append(Difference(topic, len(sent), [], [], f"{exported.kinds[topic][:2]}, not {kind[:2]}"))
    return found


def _beyond(messages: list[Recorded], known: Counter[bytes]) -> list[Recorded]:
    """Return the messages beyond the known ones."""
    beyond = []
    for message in messages:
        if known[message.data]:
            known[message.data] -= 1
        else:
            beyond.append(message)
    return beyond


def _words(kind: Kind, missing: list[Recorded], extra: list[Recorded]) -> str:
    message = kind.message()
    if not missing or not extra:
        lone, what = (missing[0], "recorded only") if missing else (extra[0], "exported only")
        return f"{what}: {fields(message, lone.data)[:6]!r:.300}"
    ours, theirs = (fields(message, one.data) for one in (missing[0], extra[0]))
    for was, now in zip(ours, theirs, strict=False):
        if was != now:
            return f"{was[0]}: {was[1]!r:.80} became {now[0]}: {now[1]!r:.80}"
    return f"{len(ours)} fields became {len(theirs)}"


def main() -> int:
    """Compare two bags; 0 if they are the same, 1 if not."""
    recorded, exported = (read(Path(name)) for name in sys.argv[1:3])
    found = compare(recorded, exported)
    for one in found:
        print(one)
    print(f"{len(recorded.messages):,} messages of {len(recorded.kinds)} topics, {len(found)} differ")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
