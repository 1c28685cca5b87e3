"""Encodes a batch's columns: numbers as steps in JSON, compressed with a preset dictionary.

A column is a list whose first entry is its decimals. After a number follow the first value and the step from
each value to the next, as integers: the values times ten to the power of the decimals. After null follow the
plain values."""

from __future__ import annotations

import base64
import binascii
import zlib
from functools import lru_cache
from itertools import accumulate
from operator import sub
from typing import Any, List, Mapping, Sequence, Union, cast

from iort_contract.checks import COMPACT, shown, wire_column
from iort_contract.limits import (
    MAX_BATCH_VALUES,
    MAX_COLUMNS_BYTES,
    MAX_FIELDS,
    MAX_SAMPLES,
    ContractError,
    Value,
)
from iort_contract.tables import EXPIRES_S, OMITTED, SECOND, STATS, TOPIC

# Batches stay readable for ever. The others keep messages of ROS 1 or ROS 2 byte for byte:
# contract/iort_contract/ros/message.py.
CODEC, ROS1_CODEC, ROS2_CODEC = "steps", "ros1", "ros2"
CODECS = (CODEC, ROS1_CODEC, ROS2_CODEC)
# A step has half the characters of its value, and takes as much memory.
_MOST_BYTES = {CODEC: MAX_COLUMNS_BYTES // 2}
_MOST_BYTES.update(dict.fromkeys((ROS1_CODEC, ROS2_CODEC), MAX_COLUMNS_BYTES + 2 * 1024 * 1024))
# zlib's preset dictionary. It is frozen with the codec's name, since stored batches need it. An unknown field
# costs its name. The end of the dictionary is the cheapest to refer to.
DICTIONARY = (
    b'"cpu_percent":[0],"rss_mb":[0],"samples_per_s":[0],"backlog_batches":[0],"backlog_bytes":[0],'
    b'"dropped_batches":[0],"connects":[0],"clock_offset_ms":[0],"clock_uncertainty_ms":[0],'
    b'"files_waiting":[0],"files_sent_bytes":[0],"broker_ms":[0],"rule_ms":[0],"lambda_ms":[0],'
    b'"temp_fet":[0],"temp_motor":[0],"avg_id":[0],"avg_iq":[0],"pid_pos_now":[0],"controller_id":[0],'
    b'"ntc_temp_mos1":[0],"ntc_temp_mos2":[0],"ntc_temp_mos3":[0],"avg_vd":[0],"avg_vq":[0],'
    b'"voltage_input":[0,0,0],"temperature_pcb":[0,0,0],"current_motor":[0,0,0],"current_input":[0,0,0],'
    b'"speed":[0,0,0],"duty_cycle":[0,0,0],"charge_drawn":[0,0,0],"charge_regen":[0,0,0],'
    b'"energy_drawn":[0,0,0],"energy_regen":[0,0,0],"displacement":[0,0,0],"distance_traveled":[0,0,0],'
    b'"fault_code":[0,0,0,0,0,0,1,0,-1,0,0,0,0,{"dt":[0,20000,19999,20001],"fields":{"voltage_input":[1,'
)
# zlib's, which a link to a robot is worth.
LEVEL = 6
# Integers below this, divided by any of these powers of ten, are equally exact in the float64 of any
# language.
EXACT = 2**53
SCALES = tuple(float(f"1e{decimals}") for decimals in range(23))


def packed_samples(
    dt: Sequence[int],
    fields: Mapping[str, Sequence[Value]],
    behind: bytes = b"",
    codec: str = CODEC,
    *,
    level: int = LEVEL,
) -> str:
    """A batch's times and columns (as made by `wire_column`) in `CODEC`, then a newline and ``behind``;
    ``level`` is zlib's.

    Raises `ContractError` if they are too large.
    """
    columns = {name: packed(column) for name, column in fields.items()}
    return written_samples(dt, columns, behind, codec, level=level)


def written_samples(
    dt: Sequence[int],
    columns: Mapping[str, Sequence[Value]],
    behind: bytes = b"",
    codec: str = CODEC,
    *,
    level: int = LEVEL,
) -> str:
    """As `packed_samples`, of columns that are `packed` already."""
    text = COMPACT.encode({"dt": dt, "fields": columns})
    if len(text) > _MOST_BYTES[CODEC]:
        raise ContractError(f"columns of a batch must be at most {_MOST_BYTES[CODEC]} bytes, got {len(text)}")
    deflater = zlib.compressobj(level, zdict=DICTIONARY)
    body = text.encode() + (b"\n" + behind if behind else b"")
    if len(body) > _MOST_BYTES[codec]:
        raise ContractError(f"batch must be at most {_MOST_BYTES[codec]} bytes, got {len(body)}")
    return base64.b64encode(deflater.compress(body) + deflater.flush()).decode()


def inflate(samples: Any, codec: str) -> bytes:
    """The JSON of a batch's columns, up to the size limit of a batch; raises `ContractError`."""
    if not isinstance(samples, (str, bytes)):
        raise ContractError(f"samples must be base64 text, got {shown(samples)}")
    most = _MOST_BYTES[codec]
    try:
        deflated = base64.b64decode(samples, validate=True)
        inflater = zlib.decompressobj(zdict=DICTIONARY)
        body = inflater.decompress(deflated, most + 1)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise ContractError(f"samples must be base64 of zlib: {error}") from error
    if len(body) > most:
        raise ContractError(f"samples must inflate to at most {most} bytes")
    if not inflater.eof or inflater.unused_data:
        raise ContractError("samples are truncated, or have trailing data")
    return body


def packed(column: Sequence[Value]) -> list[Value]:
    """Encode a column."""
    kinds = set(map(type, column))
    if kinds == {int}:
        whole, decimals = cast("Sequence[int]", column), 0
        if max(whole) < EXACT and min(whole) > -EXACT:
            return [decimals, whole[0], *map(sub, whole[1:], whole)]
    elif kinds <= {int, float}:
        scaled = _whole(cast("Sequence[float]", column))
        if scaled is not None:
            decimals, whole = scaled
            return [decimals, whole[0], *map(sub, whole[1:], whole)]
    return [None, *column]


def _whole(column: Sequence[float]) -> tuple[int, list[int]] | None:
    """The decimals that make all values integers of 53 bits, and these integers; None if there are none."""
    largest = max(*column, -min(column))
    decimals = max(map(_decimals, {column[0], column[len(column) // 2], column[-1]}))
    while decimals < len(SCALES) and largest * SCALES[decimals] < EXACT - 1:
        scale = SCALES[decimals]
        whole = list(map(round, map(scale.__mul__, column)))
        back = list(map(scale.__rtruediv__, whole))
        if back == column:
            return decimals, whole
        # The three sampled values nearly always have the most decimals; the check below finds the exceptions.
        more = max(_decimals(value) for value, near in zip(column, back) if value != near)
        if more <= decimals:
            break
        decimals = more
    return None


def _decimals(value: float) -> int:
    """The number of decimals in the value's shortest text."""
    mantissa, _, exponent = repr(value).partition("e")
    return max(0, len(mantissa.partition(".")[2]) - int(exponent or 0))


_NOT_INTEGERS = "the steps must be integers"


def unpacked(name: str, column: Any, n: int) -> list[Value]:
    """Decode ``n`` values of a column; raises `ContractError` if `packed` cannot have written it."""
    if not isinstance(column, list) or len(column) != n + 1:
        raise ContractError(f"field {name} must have {n} values")
    decimals = column[0]
    if decimals is None:
        values, nulled = wire_column(name, column[1:])
        if nulled:
            raise ContractError(f"field {name}: numbers must be finite")
        return values
    if type(decimals) is not int or not 0 <= decimals < len(SCALES):
        raise ContractError(f"field {name}: decimals must be 0 to {len(SCALES) - 1}, got {shown(decimals)}")
    # Check the first step before adding: sums of texts and lists take quadratic time.
    if type(column[1]) is not int:
        raise ContractError(f"field {name}: {_NOT_INTEGERS}")
    try:
        whole = list(accumulate(column[1:]))
    except (TypeError, OverflowError) as error:
        raise ContractError(f"field {name}: {_NOT_INTEGERS}") from error
    # An integer sum means integer steps, or booleans, which count as 1 and 0.
    if type(whole[-1]) is not int:
        raise ContractError(f"field {name}: {_NOT_INTEGERS}")
    # Sorting finds both ends in half the time of min and max.
    ordered = sorted(whole)
    if ordered[-1] >= EXACT or ordered[0] <= -EXACT:
        raise ContractError(f"field {name}: values must fit in 53 bits")
    if not decimals:
        return cast("list[Value]", whole)
    scale = SCALES[decimals]
    floats = [number / scale for number in whole]
    if any(map(float.is_integer, floats)):
        # A whole number is an integer on the wire, whatever its neighbours are.
        return [int(value) if value.is_integer() else value for value in floats]
    return cast("list[Value]", floats)


# The times, the values, and each field's name and decimals.
_MOST_COMMAS = MAX_SAMPLES + MAX_BATCH_VALUES + 2 * MAX_FIELDS
# Each text value, each name, and the two names of the body itself.
_MOST_QUOTES = 2 * (MAX_BATCH_VALUES + MAX_FIELDS + 2)
# Between two commas is a number, of 25 characters at most, perhaps with white space. A number of thousands of
# digits takes a tenth of a millisecond, and the body may hold a thousand of them.
_MOST_BETWEEN = 200
# A body below this size is always cheap.
_LITTLE = 2 * MAX_BATCH_VALUES


def check_effort(body: bytes) -> None:
    """Refuse JSON that costs more to decode than the largest allowed batch.

    It may still be invalid; the decoder checks that.
    """
    if len(body) <= _LITTLE:
        return
    if b"\\" in body:
        body = body.replace(b"\\\\", b"").replace(b'\\"', b"")
    if body.count(b'"') > _MOST_QUOTES:
        raise ContractError(f"samples must hold at most {MAX_BATCH_VALUES} values, got too many texts")
    outside = b"".join(body.split(b'"')[::2])
    if (
        outside.count(b"{") > 2
        or outside.count(b"[") > MAX_FIELDS + 1
        or outside.count(b",") > _MOST_COMMAS
        or max(map(len, outside.split(b","))) > _MOST_BETWEEN
    ):
        raise ContractError(
            f"samples must be columns of numbers and texts, of at most {MAX_BATCH_VALUES} values"
        )


# A field's entry in a second: `STATS`, or one value if all four are equal. A column that is not numeric has
# only its last value.
Statistics = Union[List[Value], Value]
_TAKEN = frozenset({TOPIC, SECOND, EXPIRES_S, OMITTED})
_SUFFIXES = tuple(f"_{statistic}" for statistic in STATS)


def packed_second(counts: Mapping[str, Value], fields: Mapping[str, Statistics]) -> dict[str, Statistics]:
    """The second as stored: its counts, and each field's statistics by its name.

    A single value of a column that is not numeric becomes ``<field>_last``. A field whose name is taken stays
    flat.
    """
    packed: dict[str, Statistics] = dict(fields)
    taken = _TAKEN.union(counts)
    flat: dict[str, Statistics] = dict(counts)
    while odd := [name for name, value in packed.items() if name in taken or type(value) is not list]:
        for name in odd:
            flat.update(_flat(name, packed.pop(name)))
        # A field may have the name of another field's statistic.
        taken |= flat.keys()
    return {**flat, **packed}


def flat_second(packed: Mapping[str, Any]) -> dict[str, Any]:
    """The second with ``<field>_min``, ``_mean``, ``_max`` and ``_last``, for any types of values."""
    flat: dict[str, Any] = {}
    for name, value in packed.items():
        flat.update(_flat(name, value) if isinstance(value, list) else {name: value})
    return flat


def _flat(name: str, statistics: Any) -> dict[str, Any]:
    if not isinstance(statistics, list):
        return {name + _SUFFIXES[-1]: statistics}
    values = statistics * len(STATS) if len(statistics) == 1 else statistics
    return dict(zip(_names(name), values))


@lru_cache(maxsize=4096)
def _names(field: str) -> tuple[str, ...]:
    return tuple([field + suffix for suffix in _SUFFIXES])
