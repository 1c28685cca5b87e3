"""Questions of a robot, or an operator's query, to a function of the cloud, and the answers."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate
from typing import Any, Mapping, NamedTuple, Sequence

from iort_contract.checks import (
    check_id,
    check_time,
    check_version,
    integer,
    json_object,
    offset_entry,
    shown,
    text,
    whole_number,
)
from iort_contract.limits import SCHEMA_VERSION, ContractError, Value
from iort_contract.messages.envelope import entries, read, to_json
from iort_contract.messages.files import MAX_FILE_BYTES, check_sha256, parse_file_key
from iort_contract.topics import check_robot, check_stream

# A larger question or answer travels as a file in the bucket, and the message names the file.
MAX_INLINE_BYTES = 100 * 1024
# The longest time that a robot waits for an answer.
MAX_ASK_MS = 60_000
# The first level of an uploaded question's file name; functions may read no other files of robots.
ASK_FOLDER = "ask"
ANSWER_URL_S = 900

# Why a question has no answer.
UNKNOWN, OVER_QUOTA, TOO_LATE, TOO_LARGE = "unknown", "over_quota", "too_late", "too_large"
MALFORMED, INVALID, NO_DATA, FAILED = "malformed", "invalid", "no_data", "failed"
REASONS = {
    UNKNOWN: "the deployment answers no such question",
    OVER_QUOTA: "the robot asked it too often within this hour, or is not registered",
    TOO_LATE: "the deadline passed before the function began",
    TOO_LARGE: "the question or its answer is larger than the question allows",
    MALFORMED: "the message is not a question",
    INVALID: "the body does not fit the question",
    NO_DATA: "the cloud has nothing to answer with",
    FAILED: "the function failed; its log has more",
}


class Content(NamedTuple):
    """A body that is a file in the bucket: where it is (a key for the cloud, an address for the robot), the
    SHA-256 of its bytes in hex, and their number."""

    place: str
    sha256: str
    size: int


class Refusal(NamedTuple):
    """Why a question is not answered: one of `REASONS`, and a text for a person."""

    reason: str
    text: str


@dataclass(frozen=True)
class Ask:
    """A question. ``id`` names it; the answer repeats it.

    An answer is wanted until ``valid_ms`` after ``sent_us``. ``offset_us`` converts ``sent_us`` to the
    cloud's time by addition, if the robot knows it. The ``body`` is an object, or a file: its key.
    """

    id: str
    sent_us: int
    valid_ms: int
    body: Mapping[str, Any] | Content
    offset_us: int | None = None

    def deadline_us(self, received_ms: int) -> int:
        """Until when an answer is wanted, by the cloud's clock. Without an offset the robot's clock says
        nothing, and the time counts from the receipt."""
        sent_us = received_ms * 1000 if self.offset_us is None else self.sent_us + self.offset_us
        return sent_us + self.valid_ms * 1000


@dataclass(frozen=True)
class Answer:
    """The answer to a question: its body, a file's address, or why there is none."""

    id: str
    body: Mapping[str, Any] | Content | Refusal


def encode_ask(ask: Ask) -> bytes:
    """The question as JSON; raises `ContractError` if it is invalid."""
    envelope: dict[str, Any] = {
        "v": SCHEMA_VERSION,
        "id": ask.id,
        "sent_us": ask.sent_us,
        "valid_ms": ask.valid_ms,
        **offset_entry(ask.offset_us),
    }
    if isinstance(ask.body, Content):
        envelope["file"] = {"key": ask.body.place, "sha256": ask.body.sha256, "size": ask.body.size}
    else:
        envelope["body"] = ask.body
    message = to_json(envelope)
    decode_ask(message)
    return message


def decode_ask(message: bytes | str) -> Ask:
    """Decode a question; raises `ContractError` for everything that `encode_ask` cannot have written."""
    envelope = json_object(message, "question")
    check_version(envelope)
    valid_ms = whole_number("valid_ms", integer(envelope, "valid_ms"), 1, MAX_ASK_MS)
    offset_us = integer(envelope, "offset_us") if "offset_us" in envelope else None
    offset_entry(offset_us)
    body = _body(envelope, "file", "key")
    if isinstance(body, Content):
        parse_file_key(body.place)
    return Ask(_id(envelope), check_time(integer(envelope, "sent_us"), "sent_us"), valid_ms, body, offset_us)


def ask_id(message: bytes | str) -> str | None:
    """A question's id, even if the rest is invalid; None if an answer could not repeat it."""
    try:
        return _id(json_object(message, "question"))
    except ContractError:
        return None


def encode_answer(answer: Answer) -> bytes:
    """The answer as JSON."""
    envelope: dict[str, Any] = {"v": SCHEMA_VERSION, "id": answer.id}
    if isinstance(answer.body, Refusal):
        envelope.update(refused=answer.body.reason, text=answer.body.text[:1000])
    elif isinstance(answer.body, Content):
        envelope["file"] = {"url": answer.body.place, "sha256": answer.body.sha256, "size": answer.body.size}
    else:
        envelope["body"] = answer.body
    return to_json(envelope)


def decode_answer(message: bytes | str) -> Answer:
    """Decode an answer; raises `ContractError` for everything that `encode_answer` cannot have written.

    A later version of the cloud may have other reasons.
    """
    envelope = json_object(message, "answer")
    check_version(envelope)
    if "refused" in envelope:
        return Answer(_id(envelope), Refusal(text(envelope, "refused"), text(envelope, "text")))
    return Answer(_id(envelope), _body(envelope, "file", "url"))


def _id(envelope: Mapping[str, Any]) -> str:
    return check_id(envelope.get("id"), "id")


def _body(envelope: Mapping[str, Any], large: str, place: str) -> Mapping[str, Any] | Content:
    file = envelope.get(large)
    if isinstance(file, Mapping):
        size = whole_number("size", integer(file, "size"), 0, MAX_FILE_BYTES)
        return Content(text(file, place), check_sha256(file.get("sha256")), size)
    body = envelope.get("body")
    if not isinstance(body, dict):
        raise ContractError(f"body must be an object, got {shown(body)}")
    return body


# An answer's samples: zlib of JSON with plain values.
_CODEC = "columns+zlib+base64"
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
    reply = {"codec": _CODEC, **asdict(replace(answer, samples=None))}
    if answer.samples is not None:
        reply["samples"] = base64.b64encode(answer.samples).decode()
    return {name: value for name, value in reply.items() if value is not None or name == "token"}


def decode_query_answer(message: bytes | str) -> QueryAnswer:
    """Decode an answer; raises `ContractError`. Missing entries and null have their defaults."""
    answer = json_object(message, "the query function's answer")
    if answer.get("error"):
        return QueryAnswer(error=text(answer, "error"))
    if answer.get("codec") != _CODEC:
        raise ContractError(f"codec must be {_CODEC}, got {shown(answer.get('codec'))}")
    present = {name: value for name, value in answer.items() if value is not None}
    if ("samples" in present) == ("url" in present):
        raise ContractError("an answer must have either samples or url")
    return read(QueryAnswer, present)


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
