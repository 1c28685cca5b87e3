"""The codec of batches that keep their messages as published.

Messages of one length are stored column by column, the first bytes of all, then the second: bytes that rarely
change between messages then compress to nearly nothing.
"""

from __future__ import annotations

from typing import Sequence

from iort_contract.checks import COMPACT, json_object, shown
from iort_contract.limits import MAX_COLUMNS_BYTES, MAX_SERIALIZED_BYTES, ContractError
from iort_contract.ros1.message import Messages

# Longer messages differ in more than they share.
_MAX_TURNED = 16 * 1024
_MAX_HEAD_BYTES = 1024 * 1024


def pack(messages: Messages) -> bytes:
    """The messages as bytes; raises `ContractError` if they are too large for a batch."""
    raws = messages.raw
    total = sum(map(len, raws))
    allowed = MAX_SERIALIZED_BYTES if len(raws) > 1 else MAX_COLUMNS_BYTES
    if total > allowed:
        raise ContractError(f"messages of a batch must be at most {allowed} bytes, got {total}")
    sizes = set(map(len, raws))
    data = b"".join(raws)
    turned = len(sizes) == 1 and 0 < max(sizes) <= _MAX_TURNED
    if turned:
        (size,) = sizes
        data = b"".join([data[at::size] for at in range(size)])
    head = {
        "type": messages.type_id,
        "layout": messages.layout,
        "sizes": max(sizes) if turned else list(map(len, raws)),
    }
    return COMPACT.encode(head).encode() + b"\n" + data


def unpack(body: bytes, n: int) -> Messages:
    """Decode ``n`` messages; raises `ContractError` for everything that `pack` cannot have written."""
    end = body.find(b"\n", 0, _MAX_HEAD_BYTES)
    if end < 0:
        raise ContractError("messages must have a head")
    head = json_object(body[:end], "the messages' head")
    data = body[end + 1 :]
    if n > 1 and len(data) > MAX_SERIALIZED_BYTES:
        raise ContractError(
            f"messages of a batch must be at most {MAX_SERIALIZED_BYTES} bytes, got {len(data)}"
        )
    kind, layout, sizes = head.get("type"), head.get("layout"), head.get("sizes")
    if not isinstance(kind, str) or not isinstance(layout, str):
        raise ContractError("messages must have a type and a layout")
    if type(sizes) is int:
        if not 0 < sizes <= _MAX_TURNED or len(data) != n * sizes:
            raise ContractError(f"messages must be {n} of {shown(sizes)} bytes, got {len(data)} bytes")
        turned = bytearray(len(data))
        for at in range(sizes):
            turned[at::sizes] = data[at * n : (at + 1) * n]
        data, sizes = bytes(turned), [sizes] * n
    return Messages(kind, layout, _parted(data, sizes, n))


def _parted(data: bytes, sizes: object, n: int) -> Sequence[bytes]:
    if not isinstance(sizes, list) or len(sizes) != n or not set(map(type, sizes)) <= {int} or min(sizes) < 0:
        raise ContractError(f"the messages' sizes must be {n} integers")
    if sum(sizes) != len(data):
        raise ContractError(f"messages must be {sum(sizes)} bytes by their sizes, got {len(data)}")
    parts, at = [], 0
    for size in sizes:
        parts.append(data[at : at + size])
        at += size
    return parts
