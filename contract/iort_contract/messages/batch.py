"""The record lane: samples of a stream in one message, which is stored unchanged."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import accumulate
from operator import itemgetter
from typing import Any, Hashable, Iterator, Mapping, NamedTuple, Sequence, Tuple

from iort_contract.checks import (
    BOOT,
    COMPACT,
    check_field,
    check_header,
    check_nonfinite,
    check_time,
    check_times,
    check_version,
    integer,
    json_object,
    shown,
    wire_column,
)
from iort_contract.codec import (
    CODEC,
    CODECS,
    check_effort,
    inflate,
    packed_samples,
    unpacked,
    written_samples,
)
from iort_contract.limits import (
    BATCH_VERSION,
    MAX_AHEAD_US,
    MAX_BATCH_VALUES,
    MAX_FIELDS,
    MAX_MESSAGE_BYTES,
    MAX_SAMPLES,
    ContractError,
    Value,
)
from iort_contract.ros.columns import as_columns, from_columns, values_a_message, view
from iort_contract.ros.message import Messages, RosMessage, pack, unpack
from iort_contract.tables import BATCH, NONFINITE, PREVIOUS, RECEIVED_MS, ROBOT, SAMPLES, TOPIC
from iort_contract.topics import RECORD, Topic, parse_topic

_BATCH_ID = re.compile(rf"(\d{{16}})-({BOOT.pattern})-(0|[1-9]\d{{0,15}})", re.ASCII)
_MAX_BATCH_ID_US = 10**16


_RUN_END = re.compile(rf"({BOOT.pattern})-(0|[1-9]\d{{0,15}})", re.ASCII)
# A batch names at most this many runs before its own.
MAX_PREVIOUS = 16


class RunEnd(NamedTuple):
    """A run of the agent, and the number of the last batch of a stream that it put into its queue."""

    boot: str
    seq: int

    def __str__(self) -> str:
        return f"{self.boot}-{self.seq}"


class BatchId(NamedTuple):
    """A batch's unique id within its topic: the time of the first sample, the agent's run, and the sequence
    number.

    As text it sorts by time, so a range of times is a range of keys.
    """

    t_us: int
    boot: str
    seq: int

    def __str__(self) -> str:
        return f"{self.t_us:016d}-{self.boot}-{self.seq}"


def batch_id(text: Any) -> BatchId:
    """Parse an id; raises `ContractError`."""
    if not isinstance(text, str):
        raise _not_an_id(text)
    return _parsed_id(text)


# Lambda 2 meets each of an event's ids several times.
@lru_cache(maxsize=1024)
def _parsed_id(text: str) -> BatchId:
    match = _BATCH_ID.fullmatch(text)
    if match is None:
        raise _not_an_id(text)
    parsed = BatchId(int(match.group(1)), match.group(2), int(match.group(3)))
    check_time(parsed.t_us, BATCH)
    check_header(parsed.boot, parsed.seq, 0)
    return parsed


def _not_an_id(text: Any) -> ContractError:
    return ContractError(f"{BATCH} must be <16 digits of microseconds>-<run>-<number>, got {shown(text)}")


def batches_between(first_us: int | None, last_us: int | None) -> tuple[str, str]:
    """The lowest and highest key of batches that start between these times, both inclusive; None is open.

    Of a range before 1970, where no batch is, the highest is below the lowest.
    """
    first = min(max(0, first_us or 0), _MAX_BATCH_ID_US - 1)
    last = _MAX_BATCH_ID_US - 1 if last_us is None else min(max(-1, last_us), _MAX_BATCH_ID_US - 1)
    # Sorts after all ids of this time: "~" is greater than any character of an id.
    return (f"{first:016d}", f"{last:016d}~") if last >= 0 else ("~", "")


def run_ends(text: Any) -> tuple[RunEnd, ...]:
    """Parse the runs before a batch's own, separated by spaces; raises `ContractError`."""
    matches = [_RUN_END.fullmatch(one) for one in text.split(" ")] if isinstance(text, str) and text else []
    ends = tuple(RunEnd(match.group(1), int(match.group(2))) for match in matches if match is not None)
    if not isinstance(text, str) or len(ends) != len(matches) or len(ends) > MAX_PREVIOUS:
        raise ContractError(f"{PREVIOUS} must be up to {MAX_PREVIOUS} of <run>-<number>, got {shown(text)}")
    for end in ends:
        check_header(end.boot, end.seq, 0)
    return ends


@dataclass(frozen=True)
class Batch:
    """Samples of one stream.

    ``boot`` names the agent's run. ``seq`` numbers the run's batches of the stream from 0 without gaps;
    before batches had ``previous``, it went on where the run before had ended. ``times_us`` are microseconds
    since the epoch, one per sample, in order and within `MAX_BATCH_SPAN_US`. ``columns`` holds a list of
    equal length per field. ``nonfinite`` counts the NaNs and infinities that became None. ``messages`` are
    the ROS messages behind the samples, if the batch holds them as published; for encoding, ``columns`` then
    hold only additional fields. ``previous`` are the runs before this one; each batch of a run names them
    until one has arrived.
    """

    boot: str
    seq: int
    times_us: Sequence[int]
    columns: Mapping[str, Sequence[Value]]
    nonfinite: int = 0
    messages: Messages | None = None
    previous: tuple[RunEnd, ...] | None = None

    @property
    def t_us(self) -> int:
        """The first sample's time."""
        return self.times_us[0]

    @property
    def id(self) -> BatchId:
        """The batch's unique id in its topic."""
        return BatchId(self.t_us, self.boot, self.seq)


def encode_batch(batch: Batch) -> bytes:
    """The envelope as JSON. NaN and infinities become null and are added to ``nonfinite``.

    Raises `ContractError` for an invalid batch. A batch too large for one message is still encoded: compare
    with `MAX_MESSAGE_BYTES` and use `split_batch`.
    """
    check_header(batch.boot, batch.seq, batch.nonfinite)
    times, n = batch.times_us, len(batch.times_us)
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"batch must have 1 to {MAX_SAMPLES} samples, got {n}")
    check_times(times)
    if times[0] < 0:
        raise ContractError(f"time must be from 1970 on, got {times[0]} us")
    dt = [0] + [b - a for a, b in zip(times, times[1:])]
    fields, nonfinite = _wire_columns(batch, n)
    codec, samples = CODEC, ""
    if batch.messages is None:
        samples = packed_samples(dt, fields)
    else:
        codec, samples = _packed_messages(batch.messages, times, dt, fields)
    check_header(batch.boot, batch.seq, nonfinite)
    envelope = {
        "v": BATCH_VERSION,
        BATCH: str(batch.id),
        SAMPLES: n,
        **({NONFINITE: nonfinite} if nonfinite else {}),
        **_previous(batch),
        "codec": codec,
        "samples": samples,
    }
    return COMPACT.encode(envelope).encode()


def _previous(batch: Batch) -> dict[str, str]:
    if batch.previous is None:
        return {}
    text = " ".join(map(str, batch.previous))
    run_ends(text)
    return {PREVIOUS: text}


def _wire_columns(batch: Batch, n: int) -> tuple[dict[str, list[Value]], int]:
    """The columns for the wire, and the total count of values that are not finite."""
    if len(batch.columns) > MAX_FIELDS:
        raise ContractError(f"batch must have at most {MAX_FIELDS} fields, got {len(batch.columns)}")
    _check_values(n, len(batch.columns))
    nonfinite = batch.nonfinite
    fields: dict[str, list[Value]] = {}
    for name, column in batch.columns.items():
        check_field(name)
        if len(column) != n:
            raise ContractError(f"field {name} must have {n} values, got {len(column)}")
        fields[name], nulled = wire_column(name, column)
        nonfinite += nulled
    return fields, nonfinite


def _packed_messages(
    messages: Messages, times: Sequence[int], dt: Sequence[int], beside: Mapping[str, Sequence[Value]]
) -> tuple[str, str]:
    """Codec and samples of messages: as columns if those hold everything, otherwise unchanged."""
    n = len(dt)
    if len(messages.raw) != n:
        raise ContractError(f"batch of {n} samples must have as many messages, got {len(messages.raw)}")
    _check_values(n, len(beside) + values_a_message(messages))
    numbers = None if beside else as_columns(messages, times)
    if numbers is not None:
        columns, about = numbers
        return CODEC, written_samples(dt, columns, about.encode())
    return messages.codec, packed_samples(dt, beside, pack(messages), messages.codec)


class Envelope(NamedTuple):
    """What a batch says beside its samples, checked; and the samples' JSON with what follows it."""

    boot: str
    seq: int
    first_us: int
    n: int
    nonfinite: int
    previous: tuple[RunEnd, ...] | None
    codec: str
    text: bytes
    behind: bytes

    @property
    def id(self) -> BatchId:
        """The batch's unique id in its topic."""
        return BatchId(self.first_us, self.boot, self.seq)

    @property
    def serialized(self) -> bool:
        """Whether the samples are ROS messages that were stored unchanged."""
        return self.codec != CODEC

    @property
    def about(self) -> str:
        """The description of ROS messages that became columns; raises `ContractError`."""
        try:
            return "" if self.serialized else self.behind.decode()
        except UnicodeDecodeError as error:
            raise ContractError(f"data after the columns must be text: {error}") from error


def read_envelope(message: bytes | str | Mapping[str, Any]) -> Envelope:
    """Check everything around the samples; raises `ContractError`, with the reason."""
    # The check for a dict is the fast one.
    envelope = message if isinstance(message, (dict, Mapping)) else json_object(message, "envelope")
    check_version(envelope, BATCH_VERSION)
    codec = envelope.get("codec")
    if codec not in CODECS:
        raise ContractError(f"codec must be {', '.join(CODECS[:-1])} or {CODECS[-1]}, got {shown(codec)}")
    first_us, boot, seq = batch_id(envelope.get(BATCH))
    n = integer(envelope, SAMPLES)
    nonfinite = check_nonfinite(integer(envelope, NONFINITE)) if NONFINITE in envelope else 0
    previous = run_ends(envelope[PREVIOUS]) if PREVIOUS in envelope else None
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"envelope must say 1 to {MAX_SAMPLES} samples, got {n}")
    text, _, behind = inflate(envelope.get("samples"), codec).partition(b"\n")
    return Envelope(boot, seq, first_us, n, nonfinite, previous, codec, text, behind)


def open_envelope(envelope: Envelope) -> tuple[list[int], Mapping[str, Any]]:
    """The times of an envelope's samples, and the columns as `iort_contract.codec.unpacked` reads them.

    Checks everything except the values, which take the most time; raises `ContractError`, with the reason.
    """
    _, _, first_us, n, _, _, _, text, _ = envelope
    check_effort(text)
    body = json_object(text, "samples")
    dt, fields = body.get("dt"), body.get("fields")
    if not isinstance(dt, list) or len(dt) != n or not isinstance(fields, dict):
        raise ContractError(f"samples must have {n} dt and an object of fields")
    if len(fields) > MAX_FIELDS:
        raise ContractError(f"samples must have at most {MAX_FIELDS} fields, got {len(fields)}")
    _check_values(n, len(fields))
    if dt[0] != 0 or not set(map(type, dt)) <= {int}:
        raise ContractError("samples: dt must be integers, the first 0")
    dt[0] = first_us
    times = list(accumulate(dt))
    check_times(times)
    for name in fields:
        check_field(name)
    # It must be text, where it is no messages.
    _ = envelope.about
    return times, fields


def decode_batch(message: bytes | str | Mapping[str, Any]) -> Batch:
    """Decode the batch in an envelope: the message as sent, or the attributes of a stored item.

    Messages stored as columns stay columns; `messages_of` rebuilds them. Raises `ContractError`, with the
    reason, for everything that `encode_batch` cannot have written.
    """
    return decode_envelope(read_envelope(message))


def decode_envelope(envelope: Envelope, *, viewed: bool = True) -> Batch:
    """Decode the samples; raises `ContractError`. Unless they are ``viewed``, ROS messages stay bytes."""
    times, fields = open_envelope(envelope)
    n = len(times)
    columns: dict[str, Sequence[Value]] = {name: unpacked(name, column, n) for name, column in fields.items()}
    batch = Batch(envelope.boot, envelope.seq, times, columns, envelope.nonfinite, None, envelope.previous)
    if not envelope.serialized:
        return batch
    messages = unpack(envelope.behind, n)
    if not viewed:
        return replace(batch, messages=messages)
    fields, nulled = view(messages)
    return replace(
        batch, columns={**fields, **columns}, nonfinite=envelope.nonfinite + nulled, messages=messages
    )


def messages_of(
    message: bytes | str | Mapping[str, Any], layouts: Mapping[str, str]
) -> tuple[Batch, Messages | None]:
    """The batch in an envelope, and its ROS messages byte for byte; None if the samples were never messages.
    Of messages that are kept as they are, the batch's columns are those beside them.

    ``layouts`` has each type's layout by its id. Raises `ContractError` as `decode_batch` does, and for an
    unknown type.
    """
    envelope = read_envelope(message)
    batch = decode_envelope(envelope, viewed=False)
    if not envelope.about:
        return batch, batch.messages
    return batch, from_columns(batch.columns, envelope.about, batch.times_us, layouts)


def _check_values(samples: int, fields: int) -> None:
    if samples * fields > MAX_BATCH_VALUES:
        raise ContractError(
            f"batch must have at most {MAX_BATCH_VALUES} values, got {samples} samples of {fields} fields"
        )


def decode_item(item: Mapping[str, Any]) -> tuple[Topic, Batch]:
    """The topic of a stored item, and its batch.

    Raises `ContractError` for an item that is not a batch of the record lane, for a body that names another
    robot than its topic, and for a time more than `MAX_AHEAD_US` after its receipt.
    """
    topic = parse_topic(item[TOPIC]) if TOPIC in item else None
    if topic is None or topic.lane != RECORD:
        raise ContractError(
            f"topic must be {RECORD}/<namespace>/<robot>/<stream>, got {shown(item.get(TOPIC))}"
        )
    if item.get(ROBOT, topic.robot) != topic.robot:
        raise ContractError(f"sent by {topic.robot} in the name of {shown(item[ROBOT])}")
    batch = decode_batch(item)
    if RECEIVED_MS in item and batch.t_us > integer(item, RECEIVED_MS) * 1000 + MAX_AHEAD_US:
        raise ContractError(
            f"time {batch.t_us} us is over a year after its receipt: the car's clock is wrong"
        )
    return topic, batch


# A batch closes at this many values: telemetry takes about 2 bytes a value in a message, random doubles 12.
MAX_VALUES = 20_000
# Or at so many bytes of serialized messages, which compress to between a tenth and all of it, and a third
# more as text.
MAX_BYTES = 96 * 1024
Sample = Tuple[int, Mapping[str, Value]]


def batches_of(boot: str, samples: Sequence[Sample]) -> Iterator[Batch]:
    """Samples of a second as batches, whose numbers are the caller's to give: one for each ROS type, or each
    set of fields, since a missing field is not the same as a null one. Samples of one time stay in order."""
    alike: dict[Hashable, list[Sample]] = {}
    for sample in sorted(samples, key=itemgetter(0)):
        values = sample[1]
        names = values.beside if isinstance(values, RosMessage) else values
        kind = values.kind.id if isinstance(values, RosMessage) else None
        alike.setdefault((kind, frozenset(names)), []).append(sample)
    for group in alike.values():
        yield _batch_of(boot, group)


def _batch_of(boot: str, samples: Sequence[Sample]) -> Batch:
    times = [t_us for t_us, _ in samples]
    first = samples[0][1]
    if isinstance(first, RosMessage):
        messages = [values for _, values in samples if isinstance(values, RosMessage)]
        beside = {name: [message.beside[name] for message in messages] for name in first.beside}
        raw = [message.raw for message in messages]
        return Batch(boot, 0, times, beside, 0, Messages(first.kind.id, first.kind.layout, raw))
    return Batch(boot, 0, times, {name: [values[name] for _, values in samples] for name in first})


def encode_fitting(batch: Batch) -> tuple[list[tuple[Batch, bytes]], list[str]]:
    """The messages of a batch: one, or those of its halves if it does not fit, down to single samples, with
    numbers from the batch's own on; and why the samples that no message can hold do not fit."""
    problem = ""
    try:
        payload = encode_batch(batch)
        if len(payload) <= MAX_MESSAGE_BYTES:
            return [(batch, payload)], []
        problem = f"the message would have {len(payload)} of {MAX_MESSAGE_BYTES} bytes"
    except ContractError as error:
        problem = str(error)
    if len(batch.times_us) > 1:
        # One bad value must not cost the others.
        first, second = split_batch(batch)
        fitting, problems = encode_fitting(first)
        more, others = encode_fitting(replace(second, seq=batch.seq + len(fitting)))
        return fitting + more, problems + others
    if batch.previous:
        # Other batches of the run name the runs before it.
        return encode_fitting(replace(batch, previous=()))
    return [], [problem]


def split_batch(batch: Batch) -> tuple[Batch, Batch]:
    """The two halves of a batch, the second with the next ``seq``.

    Raises `ContractError` for a single sample, which cannot be split.
    """
    half = len(batch.times_us) // 2
    if half == 0:
        raise ContractError(f"one sample of {len(batch.columns)} fields does not fit in a message")

    def part(which: slice, seq: int, nonfinite: int) -> Batch:
        columns = {name: column[which] for name, column in batch.columns.items()}
        messages = batch.messages
        if messages is not None:
            messages = messages._replace(raw=messages.raw[which])
        return Batch(batch.boot, seq, batch.times_us[which], columns, nonfinite, messages, batch.previous)

    return part(slice(half), batch.seq, batch.nonfinite), part(slice(half, None), batch.seq + 1, 0)
