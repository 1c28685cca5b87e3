"""A model of Lambda's mapping of a DynamoDB stream, as AWS documents it: retries, splits, discarded records.

It has no clock and no threads: time and the function's answers are arguments, batches and discarded records
are results. The embedded cloud uses it (local/emulator/fixes/stream_retries.py), and so do Lambda 2's tests.

Sources, AWS Lambda's developer guide: "Using AWS Lambda with Amazon DynamoDB", "Configuring partial batch
response with DynamoDB and Lambda", "Retain discarded records from DynamoDB"; `CreateEventSourceMapping`."""

from __future__ import annotations

import json
import zlib
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

Record = Mapping[str, Any]
# "Lambda ... batch size ... payload limit": a synchronous invocation carries at most 6 MB.
MAX_EVENT_BYTES = 6 * 1024 * 1024
_FOREVER = -1
_WHOLE = -1


@dataclass(frozen=True)
class Settings:
    """A mapping's settings; -1 means no limit, as in the API.

    The documentation does not say whether a batch is split after a partial answer that names its first
    record. ``halve_at_checkpoint`` chooses.
    """

    batch_size: int = 100
    window_s: float = 0.0
    bisect: bool = False
    max_retries: int = _FOREVER
    max_age_s: int = _FOREVER
    # Records do not age while the emulator is off.
    began_s: float = 0.0
    report_failures: bool = False
    parallel: int = 1
    halve_at_checkpoint: bool = False

    @classmethod
    def of(cls, mapping: Mapping[str, Any]) -> Settings:
        """The settings of an event source mapping as the API describes it."""

        def number(key: str, default: int) -> int:
            value = mapping.get(key)
            return default if value is None else int(value)

        return cls(
            batch_size=number("BatchSize", 100),
            window_s=number("MaximumBatchingWindowInSeconds", 0),
            bisect=bool(mapping.get("BisectBatchOnFunctionError")),
            max_retries=number("MaximumRetryAttempts", _FOREVER),
            max_age_s=number("MaximumRecordAgeInSeconds", _FOREVER),
            report_failures="ReportBatchItemFailures" in (mapping.get("FunctionResponseTypes") or []),
            parallel=number("ParallelizationFactor", 1),
        )


class Condition(str, Enum):
    """Why records were discarded, in the words of the destination's message."""

    AGE = "MaxRecordAgeExceeded"
    RETRIES = "RetryAttemptsExhausted"


@dataclass(frozen=True)
class Discarded:
    """Discarded records, for the destination."""

    condition: Condition
    records: Sequence[Record]
    attempts: int


@dataclass(frozen=True)
class Answer:
    """The result of an invocation: the function's answer, its error (also a time-out), or a throttle."""

    payload: Any = None
    error: bool = False
    throttled: bool = False


@dataclass
class _Part:
    """Records of one invocation; ``failures`` counts towards the retries."""

    records: list[Record]
    failures: int = 0


@dataclass
class Lane:
    """One of a shard's concurrent lanes: it invokes one batch after the other."""

    settings: Settings
    _waiting: deque[tuple[Record, int]] = field(default_factory=deque)
    _waiting_bytes: int = 0
    _since_s: float | None = None
    _parts: deque[_Part] = field(default_factory=deque)
    discarded: list[Discarded] = field(default_factory=list)

    def put(self, record: Record) -> None:
        """Add a record of the stream."""
        size = len(json.dumps(record, default=str))
        self._waiting.append((record, size))
        self._waiting_bytes += size

    @property
    def size(self) -> int:
        """The number of records that are neither done nor discarded."""
        return len(self._waiting) + sum(len(part.records) for part in self._parts)

    @property
    def oldest(self) -> Record | None:
        """The first record that is neither done nor discarded."""
        if self._parts:
            return self._parts[0].records[0]
        return self._waiting[0][0] if self._waiting else None

    def batch(self, now_s: float) -> list[Record]:
        """The records of the next invocation; empty if none wait or the window is still open."""
        self._expire(now_s)
        if not self._parts and self._gathered(now_s):
            records: list[Record] = []
            size = 0
            while self._waiting and len(records) < self.settings.batch_size:
                size += self._waiting[0][1]
                if records and size > MAX_EVENT_BYTES:
                    break
                records.append(self._taken())
            self._parts.append(_Part(records))
            self._since_s = None
        return list(self._parts[0].records) if self._parts else []

    @property
    def due_s(self) -> float | None:
        """When the batching window ends; None if no window is open."""
        return None if self._since_s is None else self._since_s + self.settings.window_s

    def _gathered(self, now_s: float) -> bool:
        """Whether to invoke now: "until it has gathered a full batch, the batching window expires, or the
        batch reaches the payload limit of 6 MB". The window begins with the first record after a batch. A
        retry does not wait."""
        if not self._waiting:
            self._since_s = None
            return False
        if self._since_s is None:
            self._since_s = now_s
        full = len(self._waiting) >= self.settings.batch_size or self._waiting_bytes >= MAX_EVENT_BYTES
        return full or now_s >= self._since_s + self.settings.window_s

    def _taken(self) -> Record:
        record, size = self._waiting.popleft()
        self._waiting_bytes -= size
        return record

    def answered(self, answer: Answer) -> None:
        """Take the function's answer to the last `batch`."""
        if answer.throttled:
            # "This doesn't apply to service errors or throttles where the batch didn't reach the function."
            return
        part = self._parts.popleft()
        done = _WHOLE if answer.error else self._checkpoint(part, answer.payload)
        if done is None:
            return
        halves = done == _WHOLE or self.settings.halve_at_checkpoint
        if done > 0:
            # Split at the returned number: only the rest is tried again.
            self._again(_Part(part.records[done:], part.failures), counts=not self.settings.bisect)
        elif self.settings.bisect and len(part.records) > 1 and halves:
            # "Splitting a batch does not count towards the retry quota."
            middle = len(part.records) // 2
            self._parts.appendleft(_Part(part.records[middle:], part.failures))
            self._parts.appendleft(_Part(part.records[:middle], part.failures))
        else:
            self._again(part, counts=True)

    def _again(self, part: _Part, *, counts: bool) -> None:
        part.failures += counts
        if part.failures > self.settings.max_retries != _FOREVER:
            self.discarded.append(Discarded(Condition.RETRIES, part.records, part.failures))
        else:
            self._parts.appendleft(part)

    def _checkpoint(self, part: _Part, payload: Any) -> int | None:
        """The number of records that are done; None for all, `_WHOLE` for an invalid answer."""
        if not self.settings.report_failures or not payload:
            return None
        failures = payload.get("batchItemFailures") if isinstance(payload, Mapping) else None
        if not failures:
            return None
        numbers = [record["dynamodb"]["SequenceNumber"] for record in part.records]
        named = [failure.get("itemIdentifier") for failure in failures]
        # An identifier of no record of the batch fails the whole batch.
        if not set(named) <= set(numbers):
            return _WHOLE
        # "Lambda uses the record with the lowest sequence number as the checkpoint."
        return min(numbers.index(number) for number in named)

    def _expire(self, now_s: float) -> None:
        limit_s = self.settings.max_age_s
        if limit_s == _FOREVER:
            return
        for part in list(self._parts):
            old = [record for record in part.records if self._age_s(record, now_s) > limit_s]
            if old:
                self.discarded.append(Discarded(Condition.AGE, old, part.failures))
                part.records = [record for record in part.records if self._age_s(record, now_s) <= limit_s]
                if not part.records:
                    self._parts.remove(part)
        old = []
        while self._waiting and self._age_s(self._waiting[0][0], now_s) > limit_s:
            old.append(self._taken())
        if old:
            self.discarded.append(Discarded(Condition.AGE, old, 0))

    def _age_s(self, record: Record, now_s: float) -> float:
        made_s = float(record["dynamodb"].get("ApproximateCreationDateTime", now_s))
        return now_s - max(made_s, self.settings.began_s)


class Shard:
    """A shard of the stream: its records go to lanes by the hash of the item's key.

    "Lambda still ensures in-order processing at the item (partition and sort key) level."
    """

    def __init__(self, settings: Settings) -> None:
        self.lanes = [Lane(settings) for _ in range(settings.parallel)]

    def put(self, records: Iterable[Record]) -> None:
        """Add records in the order of the stream."""
        for record in records:
            keys = record["dynamodb"]["Keys"]
            lane = _place(keys, len(self.lanes)) if len(self.lanes) > 1 else 0
            self.lanes[lane].put(record)

    @property
    def size(self) -> int:
        """The number of records that are neither done nor discarded."""
        return sum(lane.size for lane in self.lanes)

    def discarded(self) -> list[Discarded]:
        """The records discarded since the last call."""
        found = [one for lane in self.lanes for one in lane.discarded]
        for lane in self.lanes:
            lane.discarded.clear()
        return found


class Stream:
    """A stream's shards: each has the records of some partitions, keeps their order, and is read by itself.

    ``partition`` is the name of the table's partition key.
    """

    def __init__(self, settings: Settings, partition: str, shards: int) -> None:
        self.settings, self._partition = settings, partition
        self._shards = [Shard(settings) for _ in range(shards)]
        self.lanes = [lane for shard in self._shards for lane in shard.lanes]

    def put(self, records: Iterable[Record]) -> None:
        """Add records in the order of the stream."""
        for record in records:
            key = record["dynamodb"]["Keys"][self._partition]
            self._shards[_place(key, len(self._shards))].put([record])

    @property
    def size(self) -> int:
        """The number of records that are neither done nor discarded."""
        return sum(shard.size for shard in self._shards)

    @property
    def oldest(self) -> Record | None:
        """The first record that is neither done nor discarded."""
        found = [record for lane in self.lanes if (record := lane.oldest) is not None]
        return min(found, key=lambda record: str(record["dynamodb"]["SequenceNumber"]), default=None)

    def discarded(self) -> list[Discarded]:
        """The records discarded since the last call."""
        return [one for shard in self._shards for one in shard.discarded()]


def _place(key: Any, places: int) -> int:
    return zlib.crc32(json.dumps(key, sort_keys=True).encode()) % places
