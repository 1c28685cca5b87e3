"""A question to the query function and its answer: the samples of a range, selected in the cloud."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate
from typing import Any, Mapping, Sequence

from iort_contract.checks import json_object, shown, text
from iort_contract.codec.columns import PLAIN_CODEC
from iort_contract.limits import ContractError, Value
from iort_contract.messages.envelope import entries, read
from iort_contract.topics import check_robot, check_stream

# The times of a request without a start or an end.
FIRST_US, LAST_US = -(2**53), 2**53


@dataclass(frozen=True)
class QueryRequest:
    """A query for a stream's samples from ``start_us`` (inclusive) to ``end_us`` (exclusive).

    ``fields`` None means all. ``where`` is a condition of `iort_contract.expression`. With ``scan`` the
    function reads the whole table. ``token`` comes from the previous answer and continues there.
    """

    robot: str
    stream: str
    start_us: int = FIRST_US
    end_us: int = LAST_US
    fields: tuple[str, ...] | None = None
    where: str | None = None
    scan: bool = False
    token: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class QueryAnswer:
    """The answer to a request, or its ``error``.

    ``fields`` are the names in the range, with or without a matching sample. ``refused`` counts the batches
    that cannot be decoded, with the first ``reason``. ``absent`` counts values of sensors that are not
    fitted. ``token`` continues the query; None means that it is complete. ``samples`` are `packed_samples`;
    large ones are in a file at ``url``.
    """

    n: int = 0
    fields: tuple[str, ...] = ()
    items: int = 0
    pages: int = 0
    refused: int = 0
    reason: str = ""
    absent: Mapping[str, int] = field(default_factory=dict)
    token: Mapping[str, Any] | None = None
    samples: bytes | None = None
    url: str | None = None
    error: str = ""


def encode_query_request(request: QueryRequest) -> bytes:
    """The request as JSON; raises `ContractError` if it is invalid."""
    decode_query_request(entries(request))
    return json.dumps(entries(request)).encode()


def decode_query_request(event: Mapping[str, Any]) -> QueryRequest:
    """Decode a request; raises `ContractError`. Missing entries and null have their defaults."""
    request = read(QueryRequest, {name: value for name, value in event.items() if value is not None})
    check_robot(request.robot)
    check_stream(request.stream)
    start_us, end_us = (max(FIRST_US, min(LAST_US, t_us)) for t_us in (request.start_us, request.end_us))
    return replace(request, start_us=start_us, end_us=end_us)


def encode_query_answer(answer: QueryAnswer) -> dict[str, Any]:
    """The answer as an object for JSON."""
    if answer.error:
        return {"error": answer.error}
    reply = {"codec": PLAIN_CODEC, **asdict(replace(answer, samples=None))}
    if answer.samples is not None:
        reply["samples"] = base64.b64encode(answer.samples).decode()
    return {name: value for name, value in reply.items() if value is not None or name == "token"}


def decode_query_answer(message: bytes | str) -> QueryAnswer:
    """Decode an answer; raises `ContractError`. Missing entries and null have their defaults."""
    answer = json_object(message, "the query function's answer")
    if answer.get("error"):
        return QueryAnswer(error=text(answer, "error"))
    if answer.get("codec") != PLAIN_CODEC:
        raise ContractError(f"codec must be {PLAIN_CODEC}, got {shown(answer.get('codec'))}")
    given = {name: value for name, value in answer.items() if value is not None}
    if ("samples" in given) == ("url" in given):
        raise ContractError("an answer must have either samples or url")
    return read(QueryAnswer, given)


def packed_samples(times_us: Sequence[int], columns: Mapping[str, Sequence[Value]]) -> bytes:
    """Times and columns, encoded like a batch; the first time is in ``dt``."""
    dt = [*times_us[:1], *(b - a for a, b in zip(times_us, times_us[1:]))]
    return zlib.compress(json.dumps({"dt": dt, "fields": columns}, separators=(",", ":")).encode(), 1)


def unpacked_samples(packed: bytes) -> tuple[list[int], Mapping[str, list[Value]]]:
    """The times in microseconds and the columns; raises `ContractError`."""
    try:
        body = json.loads(zlib.decompress(packed))
        return list(accumulate(body["dt"])), body["fields"]
    except (KeyError, RecursionError, TypeError, ValueError, zlib.error) as error:
        raise ContractError(f"samples must be what the query function packs: {error}") from error
