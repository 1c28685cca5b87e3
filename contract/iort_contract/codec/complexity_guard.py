"""What a body may cost to read, seen before it is read.

A few kilobytes on the wire inflate to megabytes of JSON, and what those cost follows from how many values
they hold: a million empty lists take a third of a second to be made, and to be refused. So a body is looked
at as bytes first, by operations that pass over it once, in C.
"""

from __future__ import annotations

from iort_contract.limits import MAX_BATCH_VALUES, MAX_FIELDS, MAX_SAMPLES, ContractError

# The times, the values, and what each field has beside them: a name, decimals.
_MOST_COMMAS = MAX_SAMPLES + MAX_BATCH_VALUES + 2 * MAX_FIELDS
# Each text that is a value, each name, and the two names of the body itself.
_MOST_QUOTES = 2 * (MAX_BATCH_VALUES + MAX_FIELDS + 2)
# Between two commas stands a number, of 25 characters at most, and white space where somebody likes it. A
# number of thousands of digits takes a tenth of a millisecond, and the body holds a thousand of them.
_MOST_BETWEEN = 200
# In so few bytes it cannot cost much.
_LITTLE = 2 * MAX_BATCH_VALUES


def check_effort(body: bytes) -> None:
    """Refuse the JSON of columns that is dearer to read than the largest batch that is allowed.

    It may still hold too much, or be no JSON at all: whoever reads it sees that.
    """
    if len(body) <= _LITTLE:
        return
    if b"\\" in body:
        body = body.replace(b"\\\\", b"").replace(b'\\"', b"")
    if body.count(b'"') > _MOST_QUOTES:
        raise ContractError(f"samples hold too many texts: allowed is up to {MAX_BATCH_VALUES} values")
    outside = b"".join(body.split(b'"')[::2])
    if (
        outside.count(b"{") > 2
        or outside.count(b"[") > MAX_FIELDS + 1
        or outside.count(b",") > _MOST_COMMAS
        or max(map(len, outside.split(b","))) > _MOST_BETWEEN
    ):
        raise ContractError(
            f"samples hold more than columns of numbers and texts, or over {MAX_BATCH_VALUES} values"
        )
