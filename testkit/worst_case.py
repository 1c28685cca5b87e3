"""The most expensive batches for Lambda 2, each within a message. A robot may send a hundred a second."""

from __future__ import annotations

import base64
import json
import random
import zlib
from collections.abc import Iterator
from typing import NamedTuple

from iort_contract.codec import DICTIONARY
from iort_contract.limits import MAX_BATCH_VALUES
from iort_contract.messages.batch import Batch, BatchId, encode_batch
from iort_contract.tables import BATCH

_BOOT, _T_US = "0badcafe", 1_700_000_000_000_000
# The most expensive case in the current codec.
_WORST = f"{MAX_BATCH_VALUES:,} texts full of escapes"


class Case(NamedTuple):
    """A message and its description."""

    what: str
    message: bytes


def worst_batches(count: int, *, first_us: int = _T_US) -> Iterator[bytes]:
    """Yield ``count`` batches of a stream, one for each second, as expensive as the contract allows."""
    (message,) = (case.message for case in cases() if case.what == _WORST)
    envelope = json.loads(message)
    for number in range(count):
        envelope[BATCH] = str(BatchId(first_us + number * 1_000_000, _BOOT, number))
        yield json.dumps(envelope).encode()


def cases() -> Iterator[Case]:
    """Yield the most expensive batches that we know, and the largest batch of a good car."""
    n = 4000
    steps = _columns(n, [b"[3,1%s]" % (b",0" * (n - 1))] * 490)
    yield Case("two million equal values", _message(n, steps))
    lists = _columns(1, [b"[%s0]" % (b"[]," * 1_300_000)])
    yield Case("a million empty lists", _message(1, lists))
    n = MAX_BATCH_VALUES
    texts = [b"[null%s]" % ((b',"' + rb"\n" * 36 + b'"') * n)]
    yield Case(_WORST, _message(n, _columns(n, texts)))
    numbers = [b"[3,1000%s]" % (b",500" * (n - 1))]
    yield Case(f"{n:,} numbers of one field", _message(n, _columns(n, numbers)))
    chance = random.Random(1)  # noqa: S311 - a noise, not a secret
    n = 434
    columns = {f"f{i}": [round(chance.gauss(10, 3), 3) for _ in range(n)] for i in range(46)}
    batch = Batch(_BOOT, 0, range(_T_US, _T_US + 1000 * n, 1000), columns)
    yield Case(f"the agent's own largest: {n} samples of 46 fields", encode_batch(batch))


def _columns(n: int, columns: list[bytes]) -> bytes:
    named = b",".join(b'"f%d":%s' % each for each in enumerate(columns))
    return b'{"dt":[0%s],"fields":{%s}}' % (b",1" * (n - 1), named)


def _message(n: int, body: bytes) -> bytes:
    deflater = zlib.compressobj(9, zdict=DICTIONARY)
    samples = base64.b64encode(deflater.compress(body) + deflater.flush()).decode()
    head = json.loads(encode_batch(Batch(_BOOT, 0, [_T_US], {})))
    return json.dumps({**head, "n": n, "samples": samples}).encode()
