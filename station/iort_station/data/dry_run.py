"""How often a trigger of the event recorder would have fired, over what is stored of a robot.

The evaluator is the robot's, so the times are those that the robot would have found in the same samples.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from operator import itemgetter
from typing import NamedTuple

from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.samples.batches import Item, RefusedItems
from iort_analysis.samples.blocks import values
from iort_contract.catalog.derived import SOURCES
from iort_contract.catalog.streams import OWN_STREAMS
from iort_contract.dynamodb import plain, with_samples_between
from iort_contract.expression import MismatchError
from iort_contract.limits import ContractError, Value
from iort_contract.messages.batch import messages_of
from iort_contract.messages.files import ATTACHMENT_AT
from iort_contract.messages.recorder import Trigger, decode_trigger
from iort_contract.ros.message import MessageType
from iort_contract.triggers import Edge, Evaluator, Window, evaluator_of, windows
from iort_station.cloud import Cloud
from iort_station.data import inventory, ros_messages
from iort_station.data.queries import Result, query, samples
from iort_station.data.recorded import Recorded, Selection
from iort_station.data.triggers import fits, prepared, recorded_streams
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet.control import Shadow

# The windows whose messages are read, for the estimate of all.
_MEASURED = 8
# What MCAP adds to a message: its record, and its place in the index.
_RECORD_BYTES = 31 + 16
# More samples than that are averaged for a picture, into so many intervals.
_DRAWN, _BINS = 2_000_000, 20_000
_DAY_US = 86_400_000_000

Row = tuple[int, str, Mapping[str, Value]]


class Upload(NamedTuple):
    """What a stream's messages in the windows would be: the rate is the robot's own in some of them."""

    stream: str
    topics: tuple[str, ...]
    messages: int
    bytes: int


@dataclass(frozen=True)
class DryRun:
    """What a trigger would have done: all ``edges``, and the ``windows`` after cooldown and merge.

    ``samples`` were read, from ``first_us`` to ``last_us``. ``uploads`` estimates what is kept, a stream
    each, before compression; ``within_budget`` is the part of it that a day's budget lets through.
    """

    robot: str
    trigger: Trigger
    edges: Sequence[Edge]
    windows: Sequence[Window]
    samples: int = 0
    first_us: int | None = None
    last_us: int | None = None
    uploads: Sequence[Upload] = ()
    within_budget: int = 0
    refused: int = 0
    reason: str = ""
    origin: Origin = field(default_factory=Origin)

    @property
    def bytes(self) -> int:
        """Bytes of all windows."""
        return sum(upload.bytes for upload in self.uploads)


def stored_trigger(cloud: Cloud, robot: str, name: str) -> Trigger:
    """The trigger of a name in a robot's shadow; raises `StationError`."""
    triggers = Shadow(cloud, robot).read().desired.recorder.triggers
    if name not in triggers:
        known = list(triggers)
        problem = f"{robot} has no trigger {name}"
        raise unknown(problem, [name], known, f"iort recorder list {robot}")
    try:
        return decode_trigger(name, triggers[name])
    except ContractError as error:
        raise StationError(f"{robot}: the trigger {name} cannot be read: {error}") from error


def dry_run(
    cloud: Cloud,
    robot: str,
    trigger: Trigger,
    start_us: int | None = None,
    end_us: int | None = None,
    *,
    progress: PageProgress | None = None,
) -> DryRun:
    """Evaluate a trigger over a robot's stored samples, from table and archive.

    Raises `UsageError` for a trigger that no robot accepts or that is no condition, and `StationError` for
    a robot, stream or field that is not there, and for a condition that mixes numbers and texts.
    """
    trigger = prepared(cloud, robot, trigger, recorded_streams(cloud, robot))
    evaluator = evaluator_of(trigger)
    if evaluator is None:
        raise UsageError(f"{trigger.name} is fired by {trigger.on}, which no stored sample tells")
    for stream in sorted(evaluator.streams):
        inventory.check_there(cloud, robot, stream)
    read = _Read(cloud, robot, start_us, end_us, progress)
    try:
        edges = list(_edges(evaluator, read))
    except (ContractError, MismatchError) as error:
        raise StationError(f"the condition cannot be evaluated: {error}") from error
    found = windows(edges, trigger.before_us, trigger.after_us, trigger.cooldown_us)
    uploads = [] if trigger.notify else list(_uploads(cloud, robot, trigger, found))
    total = sum(upload.bytes for upload in uploads)
    return DryRun(
        robot,
        trigger,
        edges,
        found,
        read.samples,
        read.first_us,
        read.last_us,
        uploads,
        _within_budget(found, total, trigger.budget_mb_day * 1e6),
        read.refused.count,
        read.refused.reason,
        read.origin,
    )


class _Read:
    """The stored samples of a range, and what was found out while they are read."""

    def __init__(
        self,
        cloud: Cloud,
        robot: str,
        start_us: int | None,
        end_us: int | None,
        progress: PageProgress | None,
    ) -> None:
        self._cloud, self._robot, self._progress = cloud, robot, progress
        self.start_us, self.end_us = start_us, end_us
        self.samples = 0
        self.first_us: int | None = None
        self.last_us: int | None = None
        self.origin, self.refused = Origin(), RefusedItems()

    def rows(self, stream: str, fields: Sequence[str]) -> Iterator[Row]:
        """A stream's samples in order of time, with these fields, and the sources of the derived ones."""
        needed = dict.fromkeys(source for name in fields for source in SOURCES.get(name, (name,)))
        selection = Selection(
            robot=self._robot,
            stream=stream,
            start_us=self.start_us,
            end_us=self.end_us,
            fields=tuple(needed),
        )
        recorded = Recorded(self._cloud, self._robot, stream, origin=self.origin, refused=self.refused)
        for block in samples(self._cloud, selection, recorded, progress=self._progress):
            columns = [values(block.columns[name]) for name in needed]
            self.samples += len(block.times_us)
            for t_us, *row in zip(block.times_us.tolist(), *columns, strict=True):
                yield t_us, stream, dict(zip(needed, row, strict=True))

    def all(self, streams: Mapping[str, Sequence[str]]) -> Iterator[Row]:
        """The samples of several streams in order of time."""
        each = [self.rows(stream, fields) for stream, fields in sorted(streams.items())]
        for row in heapq.merge(*each, key=itemgetter(0)):
            self.first_us = row[0] if self.first_us is None else self.first_us
            self.last_us = row[0]
            yield row

    def newest_us(self) -> int | None:
        """The time of the newest sample in the range of any stream that may fire a trigger."""
        newest = None
        for stream in {*inventory.streams_of(self._cloud, self._robot)} - OWN_STREAMS:
            recorded = Recorded(self._cloud, self._robot, stream)
            last = recorded.before(self.end_us)
            for t_us in [] if last is None else recorded.block(last, lambda _name: False).times_us.tolist():
                if (self.end_us is None or t_us < self.end_us) and (newest is None or t_us > newest):
                    newest = t_us
        return newest


def _edges(evaluator: Evaluator, read: _Read) -> Iterator[Edge]:
    fields = {stream: [name for _, name in evaluator.fields.get(stream, ())] for stream in evaluator.streams}
    for t_us, stream, sample in read.all(fields):
        yield from evaluator.sample(stream, t_us, sample)
    # Only these become true without a sample of their own streams.
    timed = evaluator.rule.silences or evaluator.rule.for_us
    if timed and read.samples and (newest_us := read.newest_us()) is not None:
        yield from evaluator.advance(newest_us)
    yield from evaluator.finish()


def _uploads(cloud: Cloud, robot: str, trigger: Trigger, found: Sequence[Window]) -> Iterator[Upload]:
    """What the chosen streams' messages in the windows would take, by their rates in some of the windows."""
    if not found:
        return
    # Spread over all of them.
    step = max(1, len(found) // _MEASURED)
    measured = found[::step][:_MEASURED]
    scale = _length_us(found) / max(1, _length_us(measured))
    kinds = ros_messages.types(cloud, robot)
    for stream in inventory.streams_of(cloud, robot):
        own = {name: kind for name, kind in kinds.items() if kind.stream == stream}
        topics = tuple(sorted({kind.topic for kind in own.values()}))
        if trigger.topics and not fits(trigger.topics, stream, *topics):
            continue
        recorded = Recorded(cloud, robot, stream)
        sizes = [size for window in measured for size in _sizes(recorded, own, window)]
        if sizes:
            yield Upload(stream, topics, round(len(sizes) * scale), round(sum(sizes) * scale))


def _sizes(recorded: Recorded, kinds: Mapping[str, MessageType], window: Window) -> Iterator[int]:
    """The bytes of each message of a window in a recording."""
    layouts = {name: kind.layout for name, kind in kinds.items()}
    for items in recorded.items(with_samples_between(window.from_us, window.to_us + 1)):
        for item in items:
            yield from _of_item(item, layouts, window)


def _of_item(item: Item, layouts: Mapping[str, str], window: Window) -> Iterator[int]:
    try:
        batch, messages = messages_of(plain(item), layouts)
    except ContractError:
        return
    # What was cut out of a message is in the ring.
    fields = [name[: -len(ATTACHMENT_AT) - 1] for name in batch.columns if name.endswith(f".{ATTACHMENT_AT}")]
    cut = [batch.columns[f"{name}.size"] for name in fields if f"{name}.size" in batch.columns]
    for i, t_us in enumerate(batch.times_us):
        if not window.from_us <= t_us <= window.to_us:
            continue
        if messages is None:
            sample = {name: column[i] for name, column in batch.columns.items()}
            yield len(json.dumps(sample)) + _RECORD_BYTES
        else:
            attached = sum(size for column in cut if isinstance(size := column[i], int))
            yield len(messages.raw[i]) + attached + _RECORD_BYTES


def _length_us(of: Sequence[Window]) -> int:
    return sum(window.to_us - window.from_us for window in of)


def _within_budget(found: Sequence[Window], total: int, budget: float) -> int:
    """The bytes that the budget of each day (UTC) lets through."""
    if not budget or not found:
        return total
    days: Counter[int] = Counter()
    for window in found:
        days[window.to_us // _DAY_US] += window.to_us - window.from_us
    rate = total / max(1, _length_us(found))
    return round(sum(min(budget, length_us * rate) for length_us in days.values()))


def lines(
    cloud: Cloud, found: DryRun, start_us: int | None, end_us: int | None
) -> Iterator[tuple[str, Result, str]]:
    """The numeric fields of a condition over the range, for a picture: a robot's name, samples and a field
    of them."""
    evaluator = evaluator_of(found.trigger)
    if evaluator is None or not found.samples or found.first_us is None or found.last_us is None:
        return
    every = None
    if found.samples > _DRAWN:
        every = f"{max(1, (found.last_us - found.first_us) // _BINS)}us"
    for stream, named in sorted(evaluator.fields.items()):
        fields = list(dict.fromkeys(field for _, field in named))
        result = query(cloud, found.robot, stream, start_us, end_us, fields=fields, every=every)
        for name in fields:
            if result.columns[name].dtype.kind in "fb":
                yield found.robot, result, name
