"""Limits the cost of decoding a body, before it is decoded.

A few kilobytes on the wire inflate to megabytes of JSON, and their cost depends on the number of values: a
million empty lists take a third of a second. So a body is first checked as bytes, by operations that scan
it once, in C.
"""

from __future__ import annotations

from iort_contract.limits import MAX_BATCH_VALUES, MAX_FIELDS, MAX_SAMPLES, ContractError

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
