"""What can be played: a stored range of robots' streams, or an MCAP file, as topics and messages in order.

Each stream is a topic of its fields, with the samples of `iort query` (`fields`). What a robot recorded as
whole ROS messages has their own topics beside it, byte for byte, with their original definitions.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

from mcap.records import Channel, Schema

from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import values
from iort_contract.catalog.streams import ACCOUNT_STREAM, TYPES_STREAM
from iort_contract.dynamodb import with_samples_between
from iort_contract.ros.message import MessageType
from iort_station.bridge import fields
from iort_station.bridge.channels import Message, Topic
from iort_station.cloud import Cloud
from iort_station.data import inventory, ros_messages
from iort_station.data.export import Export
from iort_station.data.mcap_files import McapIndex
from iort_station.data.queries import samples
from iort_station.data.recorded import Recorded, Selection
from iort_station.data.ros_forms import ConversionError, Form, form_of, from_ros2
from iort_station.errors import StationError
from iort_station.fleet import files

# Streams for the station alone, not for people.
BOOKKEEPING = {ACCOUNT_STREAM, TYPES_STREAM}
_AT_ONCE = 8
_BY_TIME = attrgetter("t_ns")
# A range is read in parts, which grow: an hour of the archive is read as one, and may have gigabytes, and the
# first message must not wait for the last one.
_FIRST_US, _GROWS, _MOST_US = 10_000_000, 4, 160_000_000


class Cancelled(Exception):  # noqa: N818 - no fault
    """Nobody wants what is being read any more."""


class Source(ABC):
    """Messages of ``topics``, which are numbered by their places, from ``start_ns`` (inclusive) to ``end_ns``
    (exclusive). ``largest_bytes`` is the size of the largest message that was seen so far."""

    topics: list[Topic]
    start_ns: int
    end_ns: int
    largest_bytes = 1

    @abstractmethod
    def messages(
        self, start_ns: int, wanted: frozenset[int], check: Callable[[], None], say: Callable[[str], None], /
    ) -> Generator[Message, None, None]:
        """The messages of the wanted topics from a time on, in order of time. ``check`` is called before
        each page of what is read, and raises `Cancelled`; ``say`` takes a line about what cannot be read.

        Raises `StationError`, and the errors of botocore.
        """


class _Stream(NamedTuple):
    """A stream of a robot: the number of its fields' topic, and those of its messages by their types' ids."""

    robot: str
    stream: str
    number: int
    originals: dict[str, tuple[int, Form]]


class _Found(NamedTuple):
    """What a range has of a stream: the times of its first sample and after its last one, its fields with
    their types in JSON, and the types of its messages by their ids."""

    first_us: int
    end_us: int
    kinds: dict[str, str]
    types: dict[str, MessageType]
    largest_bytes: int


class Range(Source):
    """A range of robots' streams in a deployment; None is its begin or its end. Raises `StationError` if
    there is nothing in it."""

    def __init__(self, cloud: Cloud, robots: Sequence[str], start_us: int | None, end_us: int | None) -> None:
        self._cloud, self.topics = cloud, []
        # Threads share clients, and must not make one at the same time.
        for service in ("dynamodb", "s3"):
            cloud.client(service)
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            has = zip(robots, pool.map(partial(inventory.check_recorded, cloud), robots), strict=True)
            self._types = dict(zip(robots, pool.map(partial(ros_messages.types, cloud), robots), strict=True))
            names = [(robot, stream) for robot, streams in has for stream in streams]
            selections = [
                Selection(robot=robot, stream=stream, start_us=start_us, end_us=end_us)
                for robot, stream in names
                if stream not in BOOKKEEPING
            ]
            looked = zip(selections, pool.map(self._look, selections), strict=True)
            found = [(selection, one) for selection, one in looked if one is not None]
        if not found:
            raise StationError(
                f"{', '.join(robots)}: nothing is recorded in this range; `iort runs {robots[0]}` lists "
                "when there is something"
            )
        first_us = min(one.first_us for _, one in found) if start_us is None else start_us
        last_us = max(one.end_us for _, one in found) if end_us is None else end_us
        self.start_ns, self.end_ns = first_us * 1000, last_us * 1000
        self.largest_bytes = max(one.largest_bytes for _, one in found)
        self._streams = [self._stream(selection, one, several=len(robots) > 1) for selection, one in found]

    def _look(self, selection: Selection) -> _Found | None:
        recorded = Recorded(self._cloud, selection.robot, selection.stream)
        part, block = selection, None
        for part in _parts(selection, most_us=None):
            with closing(samples(self._cloud, part, recorded)) as blocks:
                block = next(blocks, None)
            if block is not None:
                break
        if block is None:
            return None
        end_us = selection.end_us
        if end_us is None and (last := recorded.before(None)) is not None:
            tail = recorded.parts(with_samples_between(last.t_us, None))
            end_us = 1 + max(int(part.block.times_us.max()) for part in tail if len(part.block.times_us))
        export = self._export(part)
        found = export.first()
        return _Found(
            int(block.times_us[0]),
            end_us or 0,
            fields.kinds_of(block.columns),
            export.types if found else {},
            max((len(one.raw) for one in found), default=1),
        )

    def _stream(self, selection: Selection, found: _Found, *, several: bool) -> _Stream:
        robot, stream = selection.robot, selection.stream
        prefix = f"/{robot}" if several else ""
        published = next(reversed(found.types.values()), None)
        kind = published or inventory.assumed_kind(stream, found.kinds.keys())
        unit = partial(inventory.unit, stream, kind=kind)
        number = self._add(fields.topic_of(stream, found.kinds, unit, prefix))
        originals: dict[str, tuple[int, Form]] = {}
        for name, kind in found.types.items():
            form = form_of(kind, ros2=from_ros2(kind))
            encoding, schema = ("cdr", "ros2msg") if form.ros2 else ("ros1", "ros1msg")
            topic = Topic(f"{prefix}{kind.topic}", encoding, form.kind, schema, form.definition.encode())
            originals[name] = self._add(topic), form
        return _Stream(robot, stream, number, originals)

    def _add(self, topic: Topic) -> int:
        # Several publishers of a topic are one.
        if topic not in self.topics:
            self.topics.append(topic)
        return self.topics.index(topic)

    def messages(
        self, start_ns: int, wanted: frozenset[int], check: Callable[[], None], say: Callable[[str], None]
    ) -> Generator[Message, None, None]:
        start_us = -(-start_ns // 1000)
        with ExitStack() as stack:
            each: list[Iterator[Message]] = []
            for stream in self._streams:
                selection = Selection(
                    robot=stream.robot, stream=stream.stream, start_us=start_us, end_us=self.end_ns // 1000
                )
                if stream.number in wanted:
                    sampled = self._samples(stream, selection, check, say)
                    each.append(stack.enter_context(closing(sampled)))
                if wanted.intersection(number for number, _ in stream.originals.values()):
                    published = self._published(stream, selection, wanted, check, say)
                    each.append(stack.enter_context(closing(published)))
            yield from heapq.merge(*each, key=_BY_TIME)

    def _samples(
        self, stream: _Stream, selection: Selection, check: Callable[[], None], say: Callable[[str], None]
    ) -> Generator[Message, None, None]:
        recorded, absent = Recorded(self._cloud, stream.robot, stream.stream), Counter[str]()
        for part in _parts(selection):
            check()
            blocks = samples(
                self._cloud, part, recorded, absent=absent, progress=lambda _more, _last_us: check()
            )
            with closing(blocks):
                for block in blocks:
                    columns = {name: values(column) for name, column in block.columns.items()}
                    for i, t_us in enumerate(block.times_us.tolist()):
                        sample = {name: column[i] for name, column in columns.items()}
                        yield Message(t_us * 1000, stream.number, fields.encoded(sample))
        _say_refused(recorded.refused, say)

    def _published(
        self,
        stream: _Stream,
        selection: Selection,
        wanted: frozenset[int],
        check: Callable[[], None],
        say: Callable[[str], None],
    ) -> Generator[Message, None, None]:
        for part in _parts(selection):
            check()
            export = self._export(part)
            published = export.in_order(lambda _more, _last_us: check())
            with closing(published):
                for t_us, name, raw in published:
                    number, form = stream.originals.get(name, (-1, None))
                    if form is None or number not in wanted:
                        continue
                    try:
                        yield Message(t_us * 1000, number, form.convert(raw))
                    except ConversionError as error:
                        say(str(error))
            _say_refused(export.refused, say)

    def _export(self, selection: Selection) -> Export:
        types = self._types[selection.robot]
        own = {name: kind for name, kind in types.items() if kind.stream == selection.stream}
        return Export(self._cloud, selection, own, lambda key: files.content(self._cloud, key))


def _parts(selection: Selection, *, most_us: int | None = _MOST_US) -> Iterator[Selection]:
    """A selection's range, some at a time; an open one is read as a whole."""
    start_us, end_us, length_us = selection.start_us, selection.end_us, _FIRST_US
    if start_us is None or end_us is None or start_us >= end_us:
        yield selection
        return
    while start_us < end_us:
        yield replace(selection, start_us=start_us, end_us=min(end_us, start_us + length_us))
        start_us += length_us
        length_us = length_us * _GROWS if most_us is None else min(length_us * _GROWS, most_us)


def _say_refused(refused: RefusedItems, say: Callable[[str], None]) -> None:
    if refused.count:
        say(f"{refused.count:,} stored items cannot be read and are left out; the first: {refused.reason}")


class McapFile(Source):
    """An MCAP file, also a robot's incident. Raises `StationError` if it cannot be read."""

    def __init__(self, path: Path) -> None:
        self._index, self.topics = McapIndex(path), []
        self.start_ns, self.end_ns = self._index.start_ns, self._index.end_ns
        self._numbers: dict[int, int] = {}
        for channel in self._index.channels.values():
            topic = _topic_of(channel, self._index.schemas.get(channel.schema_id))
            if topic not in self.topics:
                self.topics.append(topic)
            self._numbers[channel.id] = self.topics.index(topic)
        self.largest_bytes = self._index.chunk_bytes // 16

    def messages(
        self, start_ns: int, wanted: frozenset[int], _check: Callable[[], None], _say: Callable[[str], None]
    ) -> Generator[Message, None, None]:
        channels = {channel for channel, number in self._numbers.items() if number in wanted}
        with closing(self._index.messages(channels, start_ns, self.end_ns)) as messages:
            for one in messages:
                yield Message(one.log_ns, self._numbers[one.channel], one.data)


def _topic_of(channel: Channel, schema: Schema | None) -> Topic:
    if schema is None:
        return Topic(channel.topic, channel.message_encoding, "", "", b"")
    return Topic(channel.topic, channel.message_encoding, schema.name, schema.encoding, schema.data)
