"""Files: how a robot asks where to upload one, and what it is answered."""

from __future__ import annotations

import calendar
import json
import re
import time
from dataclasses import dataclass
from typing import Any, Mapping, NamedTuple, Sequence

from iort_contract.checks import BOOT, check_time, check_version, checked, integer, json_object, shown, text
from iort_contract.limits import SCHEMA_VERSION, ContractError
from iort_contract.tables import T_US
from iort_contract.topics import check_robot

# Where robots upload to, in the files' bucket.
FILES_PREFIX = "robots/"
# S3 takes parts of 5 MiB and more, up to 10,000 of them, and SHA-256 of each part.
PART_BYTES = 8 * 1024 * 1024
MAX_FILE_BYTES = 64 * 1024**3
# A signed address takes 2 KB, most of it the function's session.
MAX_ADDRESSES = 16
UPLOAD_URL_S = 900
KINDS = ("recording", "image", "log", "message", "other")

# What stands in a sample for a field that is too large for a message, as <field>.<one of these>: the
# claim check. All are null where the content was not kept, and the thumbnail where there is none.
CLAIM_FIELDS = {
    "key": "where the content is, or will be, in the files' bucket",
    "sha256": "of the content, in hex",
    "size": "bytes of content",
    "content_type": "of the content",
    "thumbnail": "of an image: base64 of a small JPEG",
}
# And where in the serialized message the content was, which is an empty array there.
CLAIM_AT = "at"

_FILE_LEVEL = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"
_FILE_NAME = re.compile(rf"{_FILE_LEVEL}(/{_FILE_LEVEL}){{0,3}}")
_CONTENT_TYPE = re.compile(r"[a-z0-9.+-]{1,50}/[a-z0-9.+-]{1,50}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MAX_WAIT_S = 86_400


@dataclass(frozen=True)
class File:
    """A file that a robot has: its name (up to four levels), one of `KINDS`, its content type and size,
    the SHA-256 of its content in hex, and the time it was last written, microseconds since the epoch."""

    name: str
    kind: str
    content_type: str
    size: int
    sha256: str
    t_us: int

    @property
    def parts(self) -> int:
        """Of how many parts the upload is: 1 for a file that goes in one piece."""
        return max(1, -(-self.size // PART_BYTES))


@dataclass(frozen=True)
class FileRequest:
    """Asks where a file may be uploaded to, and says at the end that it is.

    ``id`` names the request, the answer repeats it. ``parts`` maps number (from 1) to SHA-256 of those
    parts whose addresses are wanted, at most `MAX_ADDRESSES`; a file of one part names that. ``parts_sha256``
    says that all parts are there: it is the SHA-256 of their SHA-256, one after the other.
    """

    id: str
    file: File
    parts: Mapping[int, str]
    parts_sha256: str | None = None


class Address(NamedTuple):
    """Where to PUT a part (or the file, if it has but one), with exactly these headers."""

    part: int
    url: str
    headers: Mapping[str, str]


@dataclass(frozen=True)
class FileAnswer:
    """``stored``: the bucket has it, under ``key``. Otherwise ``addresses`` of what it lacks, and
    ``have``, the ranges (first, last) of parts that it has. ``refused`` says why there are none, and
    ``again_s`` after how many seconds it is worth to ask again; None: never."""

    id: str
    key: str | None = None
    stored: bool = False
    have: Sequence[tuple[int, int]] = ()
    addresses: Sequence[Address] = ()
    refused: str | None = None
    again_s: int | None = None


def file_key(robot: str, file: File) -> str:
    """The key of a robot's file in the bucket. It follows from the file alone, so that robot and cloud
    need not tell each other, and it names the content, so that no other content can have it."""
    moment = time.gmtime(_check_file(file).t_us // 1_000_000)
    day, second = time.strftime("%Y/%m/%d", moment), time.strftime("%H%M%S", moment)
    return f"{FILES_PREFIX}{check_robot(robot)}/{day}/{second}-{file.sha256[:12]}/{file.name}"


class FileKey(NamedTuple):
    """What a key says of its file: whose it is, the second it was last written (since the epoch), the
    first 12 digits of its SHA-256, and its name."""

    robot: str
    second: int
    digits: str
    name: str


_FILE_KEY = re.compile(
    rf"{FILES_PREFIX}([^/]+)/(\d{{4}}/\d\d/\d\d/\d{{6}})-([0-9a-f]{{12}})/({_FILE_LEVEL}(?:/{_FILE_LEVEL}){{0,3}})"
)


def parse_file_key(key: str) -> FileKey:
    """Take a key apart; raises `ContractError` for one that `file_key` cannot have built."""
    match = _FILE_KEY.fullmatch(key)
    if match is None:
        raise ContractError(f"key {shown(key)}: expected {FILES_PREFIX}<robot>/<day>/<time>-<hash>/<name>")
    robot, when, digits, name = match.groups()
    try:
        second = calendar.timegm(time.strptime(when, "%Y/%m/%d/%H%M%S"))
    except ValueError as error:
        raise ContractError(f"key {shown(key)}: {when} is no time") from error
    return FileKey(check_robot(robot), second, digits, name)


def part_range(file: File, part: int) -> tuple[int, int]:
    """Where a part begins in its file, and its size; raises `ContractError` for one that it does not have."""
    if type(part) is not int or not 1 <= part <= file.parts:
        raise ContractError(f"part {shown(part)}: allowed is 1 to {file.parts}")
    first = (part - 1) * PART_BYTES
    return first, min(PART_BYTES, file.size - first)


def encode_file_request(request: FileRequest) -> bytes:
    """The request as JSON. Raises `ContractError` for one that is not allowed."""
    _check_file_request(request)
    file = request.file
    envelope: dict[str, Any] = {
        "v": SCHEMA_VERSION,
        "id": request.id,
        "file": {
            "name": file.name,
            "kind": file.kind,
            "content_type": file.content_type,
            "size": file.size,
            "sha256": file.sha256,
            T_US: file.t_us,
        },
        "parts": {str(part): sha256 for part, sha256 in request.parts.items()},
    }
    if request.parts_sha256 is not None:
        envelope["parts_sha256"] = request.parts_sha256
    return json.dumps(envelope, separators=(",", ":")).encode()


def decode_file_request(message: bytes | str | Mapping[str, Any]) -> FileRequest:
    """Read a request; raises `ContractError` for what `encode_file_request` cannot have written."""
    envelope = message if isinstance(message, Mapping) else json_object(message, "file request")
    check_version(envelope)
    given, parts = envelope.get("file"), envelope.get("parts")
    if not isinstance(given, Mapping) or not isinstance(parts, Mapping):
        raise ContractError("file and parts: expected an object each")
    file = File(
        name=text(given, "name"),
        kind=text(given, "kind"),
        content_type=text(given, "content_type"),
        size=integer(given, "size"),
        sha256=text(given, "sha256"),
        t_us=integer(given, T_US),
    )
    numbered = {int(n) if str(n).isdecimal() and len(str(n)) < 6 else -1: sha for n, sha in parts.items()}
    request = FileRequest(text(envelope, "id"), file, numbered, envelope.get("parts_sha256"))
    _check_file_request(request)
    return request


def file_request_id(message: Mapping[str, Any]) -> str | None:
    """The id of a request, whatever else it says; None where it has none that an answer could repeat."""
    given = message.get("id")
    return given if isinstance(given, str) and BOOT.fullmatch(given) else None


def encode_file_answer(answer: FileAnswer) -> bytes:
    """The answer as JSON, without what it does not say."""
    envelope: dict[str, Any] = {"v": SCHEMA_VERSION, "id": answer.id}
    if answer.refused is not None:
        envelope["refused"] = answer.refused
        if answer.again_s is not None:
            envelope["again_s"] = answer.again_s
    else:
        envelope.update(key=answer.key, stored=answer.stored)
    if answer.have:
        envelope["have"] = [list(one) for one in answer.have]
    if answer.addresses:
        envelope["addresses"] = [one._asdict() for one in answer.addresses]
    return json.dumps(envelope, separators=(",", ":")).encode()


def decode_file_answer(message: bytes | str) -> FileAnswer:
    """Read an answer; raises `ContractError` for what `encode_file_answer` cannot have written."""
    envelope = json_object(message, "file answer")
    check_version(envelope)
    given_id = checked(BOOT, envelope.get("id"), "id", "8 to 32 of 0-9 a-f")
    if "refused" in envelope:
        again_s = integer(envelope, "again_s") if "again_s" in envelope else None
        if again_s is not None and not 0 <= again_s <= _MAX_WAIT_S:
            raise ContractError(f"again_s {again_s}: allowed is 0 to {_MAX_WAIT_S}")
        return FileAnswer(given_id, refused=str(envelope["refused"]), again_s=again_s)
    key, stored = envelope.get("key"), envelope.get("stored")
    if not isinstance(key, str) or not isinstance(stored, bool):
        raise ContractError("key and stored: expected a text, and true or false")
    try:
        have = tuple((int(first), int(last)) for first, last in envelope.get("have", ()))
        addresses = tuple(
            Address(int(one["part"]), str(one["url"]), {str(k): str(v) for k, v in one["headers"].items()})
            for one in envelope.get("addresses", ())
        )
    except (ArithmeticError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ContractError(f"have or addresses are not what they should be: {error}") from error
    if any(later[0] <= earlier[1] for earlier, later in zip(have, have[1:])):
        raise ContractError("have: expected ranges in order, of which none overlap")
    return FileAnswer(given_id, key, stored, have, addresses)


def _check_file_request(request: FileRequest) -> None:
    checked(BOOT, request.id, "id", "8 to 32 of 0-9 a-f")
    file = _check_file(request.file)
    if len(request.parts) > MAX_ADDRESSES:
        raise ContractError(f"{len(request.parts)} parts asked for: allowed is up to {MAX_ADDRESSES}")
    for part, sha256 in request.parts.items():
        part_range(file, part)
        checked(_SHA256, sha256, f"SHA-256 of part {part}", "64 of 0-9 a-f")
    if request.parts_sha256 is not None:
        checked(_SHA256, request.parts_sha256, "parts_sha256", "64 of 0-9 a-f")


def _check_file(file: File) -> File:
    checked(_FILE_NAME, file.name, "file name", "up to 4 levels of A-Z a-z 0-9 . _ -, up to 100 each")
    if file.kind not in KINDS:
        raise ContractError(f"kind {shown(file.kind)}: allowed is one of {', '.join(KINDS)}")
    checked(_CONTENT_TYPE, file.content_type, "content type", "type/subtype in lower case")
    checked(_SHA256, file.sha256, "SHA-256", "64 of 0-9 a-f")
    if type(file.size) is not int or not 0 <= file.size <= MAX_FILE_BYTES:
        raise ContractError(f"size {shown(file.size)}: allowed is 0 to {MAX_FILE_BYTES} bytes")
    if check_time(file.t_us, "file time") < 0:
        raise ContractError(f"file time {file.t_us}: allowed is from 1970 on")
    return file
