"""The record lane: consecutive samples of a stream in one message, which is stored as it is."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Mapping, Sequence

from contract.checks import (
    COMPACT,
    check_field,
    check_header,
    check_times,
    check_version,
    integer,
    json_object,
    shown,
    wire_column,
)
from contract.columns import CODEC, PLAIN_CODEC, inflate, packed_samples, unpacked
from contract.effort import check_effort
from contract.limits import (
    MAX_AHEAD_US,
    MAX_BATCH_VALUES,
    MAX_FIELDS,
    MAX_SAMPLES,
    SCHEMA_VERSION,
    ContractError,
    Value,
)
from contract.tables import NONFINITE, RECEIVED_MS, ROBOT, SAMPLES, T_US, TOPIC
from contract.topics import RECORD, Topic, parse_topic


@dataclass(frozen=True)
class Batch:
    """Consecutive samples of one stream.

    ``boot`` names the agent's run; ``seq`` numbers the stream's batches without a hole, across
    restarts where the spool is durable; ``times_us`` are microseconds since the epoch, one a sample,
    strictly increasing and within `MAX_BATCH_SPAN_US`; ``columns`` holds a list of equal length a
    field; ``nonfinite`` counts the NaNs and infinities that became None.
    """

    boot: str
    seq: int
    times_us: Sequence[int]
    columns: Mapping[str, Sequence[Value]]
    nonfinite: int = 0

    @property
    def t_us(self) -> int:
        """The first sample's time, which is the stored item's sort key."""
        return self.times_us[0]


def encode(batch: Batch) -> bytes:
    """The envelope as JSON. NaN and infinities become null and are added to ``nonfinite``.

    Raises `ContractError` where the batch is not allowed; a batch too large for one message is
    encoded all the same: compare with `MAX_MESSAGE_BYTES` and use `split`.
    """
    check_header(batch.boot, batch.seq, batch.nonfinite)
    times, n = batch.times_us, len(batch.times_us)
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"batch of {n} samples: allowed is 1 to {MAX_SAMPLES}")
    if len(batch.columns) > MAX_FIELDS:
        raise ContractError(f"batch of {len(batch.columns)} fields: allowed is up to {MAX_FIELDS}")
    _check_values(n, len(batch.columns))
    nonfinite = batch.nonfinite
    fields: dict[str, list[Value]] = {}
    for name, column in batch.columns.items():
        check_field(name)
        if len(column) != n:
            raise ContractError(f"field {name}: {len(column)} values for {n} samples")
        fields[name], nulled = wire_column(name, column)
        nonfinite += nulled
    check_header(batch.boot, batch.seq, nonfinite)
    check_times(times)
    dt = [0] + [b - a for a, b in zip(times, times[1:])]
    envelope = {
        "v": SCHEMA_VERSION,
        "boot": batch.boot,
        "seq": batch.seq,
        T_US: times[0],
        SAMPLES: n,
        NONFINITE: nonfinite,
        "codec": CODEC,
        "samples": packed_samples(dt, fields),
    }
    return COMPACT.encode(envelope).encode()


def decode(message: bytes | str | Mapping[str, Any]) -> Batch:
    """The batch in an envelope: the message as sent, or the attributes of a stored item.

    Raises `ContractError`, naming what is wrong, for anything that `encode` cannot have written.
    """
    envelope = message if isinstance(message, Mapping) else json_object(message, "envelope")
    check_version(envelope)
    codec = envelope.get("codec")
    if codec not in (CODEC, PLAIN_CODEC):
        raise ContractError(f"codec {shown(codec)}: this side knows {CODEC} and {PLAIN_CODEC}")
    seq = integer(envelope, "seq")
    first_us, n = integer(envelope, T_US), integer(envelope, SAMPLES)
    nonfinite = integer(envelope, NONFINITE)
    boot = check_header(envelope.get("boot"), seq, nonfinite)
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"envelope says {n} samples: allowed is 1 to {MAX_SAMPLES}")
    text = inflate(envelope.get("samples"), codec)
    check_effort(text)
    body = json_object(text, "samples")
    dt, fields = body.get("dt"), body.get("fields")
    if not isinstance(dt, list) or len(dt) != n or not isinstance(fields, dict):
        raise ContractError(f"samples: expected {n} dt and an object of fields")
    if len(fields) > MAX_FIELDS:
        raise ContractError(f"samples of {len(fields)} fields: allowed is up to {MAX_FIELDS}")
    _check_values(n, len(fields))
    if dt[0] != 0 or not set(map(type, dt)) <= {int}:
        raise ContractError("samples: dt must be integers, the first 0")
    columns = {}
    for name, column in fields.items():
        check_field(name)
        columns[name] = unpacked(codec, name, column, n)
    times = list(accumulate(dt, initial=first_us))[1:]
    check_times(times)
    return Batch(boot, seq, times, columns, nonfinite)


def _check_values(samples: int, fields: int) -> None:
    if samples * fields > MAX_BATCH_VALUES:
        raise ContractError(
            f"{samples} samples of {fields} fields: allowed is up to {MAX_BATCH_VALUES} values in a batch"
        )


def decode_item(item: Mapping[str, Any]) -> tuple[Topic, Batch]:
    """Whose a stored item is, and its batch.

    Raises `ContractError` for one that is no batch, that is not of the record lane, whose body names
    another robot than its topic, or whose time is before 1970 or `MAX_AHEAD_US` after its receipt.
    """
    topic = parse_topic(item[TOPIC]) if TOPIC in item else None
    if topic is None or topic.lane != RECORD:
        raise ContractError(f"topic {shown(item.get(TOPIC))}: expected {RECORD}/<namespace>/<robot>/<stream>")
    if item.get(ROBOT, topic.robot) != topic.robot:
        raise ContractError(f"sent by {topic.robot} in the name of {shown(item[ROBOT])}")
    batch = decode(item)
    if batch.t_us < 0:
        raise ContractError(f"time {batch.t_us} us: before 1970")
    if RECEIVED_MS in item and batch.t_us > integer(item, RECEIVED_MS) * 1000 + MAX_AHEAD_US:
        raise ContractError(f"time {batch.t_us} us: over a year after its receipt; the car's clock is wrong")
    return topic, batch


def split(batch: Batch) -> tuple[Batch, Batch]:
    """The two halves of a batch, the second with the next ``seq``.

    Raises `ContractError` for a single sample, which cannot be made smaller.
    """
    half = len(batch.times_us) // 2
    if half == 0:
        raise ContractError(f"one sample of {len(batch.columns)} fields does not fit in a message")
    first = {name: column[:half] for name, column in batch.columns.items()}
    second = {name: column[half:] for name, column in batch.columns.items()}
    return (
        Batch(batch.boot, batch.seq, batch.times_us[:half], first, batch.nonfinite),
        Batch(batch.boot, batch.seq + 1, batch.times_us[half:], second, 0),
    )
