"""Requests of robots for upload addresses, and their answers."""

from __future__ import annotations

import calendar
import re
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Mapping, NamedTuple, Sequence

from iort_contract.checks import BOOT, check_id, check_time, checked, shown, whole_number
from iort_contract.limits import ContractError
from iort_contract.messages.envelope import codec, each, read
from iort_contract.topics import check_robot

# Where robots upload to, in the files' bucket.
FILES_PREFIX = "robots/"
# S3 takes up to 10,000 parts of 5 MiB and more, with a SHA-256 each.
PART_BYTES = 8 * 1024 * 1024
MAX_FILE_BYTES = 64 * 1024**3
# A signed address takes 2 KB, most of it the function's session.
MAX_ADDRESSES = 16
UPLOAD_URL_S = 900
KINDS = ("recording", "image", "log", "message", "other")

# The attachment: these fields replace a field too large for a message, as <field>.<name>. All are null if the
# content was not kept; the thumbnail is null if the field has none.
ATTACHMENT_FIELDS = {
    "key": "the content's key in the files' bucket, also before its upload",
    "sha256": "SHA-256 of the content, in hex",
    "size": "bytes of content",
    "content_type": "the content's type",
    "thumbnail": "of an image: base64 of a small JPEG",
}
# The place of the content in the serialized message: an empty array there, or in ROS 2 one of up to 7 bytes.
ATTACHMENT_AT = "at"

_FILE_LEVEL = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"
_FILE_NAME = re.compile(rf"{_FILE_LEVEL}(/{_FILE_LEVEL}){{0,3}}")
_CONTENT_TYPE = re.compile(r"[a-z0-9.+-]{1,50}/[a-z0-9.+-]{1,50}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MAX_WAIT_S = 86_400


@dataclass(frozen=True)
class File:
    """A file on a robot: its name (up to four levels), one of `KINDS`, its content type and size, the SHA-256
    of its content in hex, and its modification time in microseconds since the epoch."""

    name: str
    kind: str
    content_type: str
    size: int
    sha256: str
    t_us: int

    @property
    def parts(self) -> int:
        """The number of parts of the upload: 1 for a file in one piece."""
        return max(1, -(-self.size // PART_BYTES))


@dataclass(frozen=True)
class FileRequest:
    """Asks for upload addresses, and at the end reports the upload.

    ``id`` names the request; the answer repeats it. ``parts`` maps the number (from 1) to the SHA-256 of each
    part to upload next, at most `MAX_ADDRESSES`; a file of one part names that part. ``parts_sha256`` reports
    that all parts are there: it is the SHA-256 of their SHA-256, in order.
    """

    id: str
    file: File
    parts: Mapping[int, str]
    parts_sha256: str | None = None


@dataclass(frozen=True)
class Address:
    """Where to PUT a part (or the whole file), with exactly these headers."""

    part: int
    url: str
    headers: Mapping[str, str]


@dataclass(frozen=True)
class FileAnswer:
    """``stored``: whether the bucket has the file under ``key``. If not, ``addresses`` are for missing parts,
    and ``have`` lists the ranges (first, last) of stored parts. ``refused`` says why the request failed, and
    ``again_s`` is the delay in seconds before another attempt; None: never."""

    id: str
    key: str | None = None
    stored: bool | None = None
    have: Sequence[tuple[int, int]] = ()
    addresses: Sequence[Address] = ()
    refused: str | None = None
    again_s: int | None = None


def file_key(robot: str, file: File) -> str:
    """The key of a robot's file in the bucket. It follows from the file alone, so robot and cloud compute it
    independently. It names the content, so other content has another key."""
    moment = time.gmtime(_check_file(file).t_us // 1_000_000)
    day, second = time.strftime("%Y/%m/%d", moment), time.strftime("%H%M%S", moment)
    return f"{FILES_PREFIX}{check_robot(robot)}/{day}/{second}-{file.sha256[:12]}/{file.name}"


class FileKey(NamedTuple):
    """A parsed key: the file's robot, the second of its modification (since the epoch), the first 12 digits
    of its SHA-256, and its name."""

    robot: str
    second: int
    digits: str
    name: str


_FILE_KEY = re.compile(
    rf"{FILES_PREFIX}([^/]+)/(\d{{4}}/\d\d/\d\d/\d{{6}})-([0-9a-f]{{12}})/({_FILE_LEVEL}(?:/{_FILE_LEVEL}){{0,3}})"
)


def parse_file_key(key: str) -> FileKey:
    """Parse a key; raises `ContractError` for one that `file_key` cannot have built."""
    match = _FILE_KEY.fullmatch(key)
    if match is None:
        raise ContractError(f"key must be {FILES_PREFIX}<robot>/<day>/<time>-<hash>/<name>, got {shown(key)}")
    robot, when, digits, name = match.groups()
    try:
        second = calendar.timegm(time.strptime(when, "%Y/%m/%d/%H%M%S"))
    except ValueError as error:
        raise ContractError(f"key {shown(key)}: time must be valid, got {when}") from error
    return FileKey(check_robot(robot), second, digits, name)


def part_range(file: File, part: int) -> tuple[int, int]:
    """A part's start in its file, and its size; raises `ContractError` if the file has no such part."""
    if type(part) is not int or not 1 <= part <= file.parts:
        raise ContractError(f"part must be 1 to {file.parts}, got {shown(part)}")
    first = (part - 1) * PART_BYTES
    return first, min(PART_BYTES, file.size - first)


def file_request_id(message: Mapping[str, Any]) -> str | None:
    """A request's id, even if the rest is invalid; None if an answer could not repeat it."""
    request_id = message.get("id")
    return request_id if isinstance(request_id, str) and BOOT.fullmatch(request_id) else None


def _ranges(content: Any) -> tuple[tuple[int, int], ...]:
    try:
        ranges = tuple((int(first), int(last)) for first, last in content)
    except (ArithmeticError, TypeError, ValueError) as error:
        raise ContractError(f"have must be ranges: {error}") from error
    if any(later[0] <= earlier[1] for earlier, later in zip(ranges, ranges[1:])):
        raise ContractError("have must be ranges in order, without overlaps")
    return ranges


def _addresses(content: Any) -> tuple[Address, ...]:
    if not isinstance(content, (list, tuple)):
        raise ContractError(f"addresses must be a list, got {shown(content)}")
    return tuple(read(Address, address, headers=each(str)) for address in content)


def _check_file_answer(answer: FileAnswer) -> None:
    check_id(answer.id, "id")
    if answer.again_s is not None:
        whole_number("again_s", answer.again_s, 0, _MAX_WAIT_S)
    if answer.refused is None and (answer.key is None or answer.stored is None):
        raise ContractError("an answer must have a key and say if the file is stored, or say why not")


encode_file_answer, decode_file_answer = codec(
    FileAnswer, "file answer", _check_file_answer, have=_ranges, addresses=_addresses
)


def check_sha256(value: object, what: str = "SHA-256") -> str:
    """Return the value if it is a SHA-256 in hex."""
    return checked(_SHA256, value, what, "64 of 0-9 a-f")


def _parts(content: Any) -> dict[int, Any]:
    if not isinstance(content, Mapping):
        raise ContractError(f"parts must be an object, got {shown(content)}")
    return {int(n) if str(n).isdecimal() and len(str(n)) < 6 else -1: sha for n, sha in content.items()}


def _check_file_request(request: FileRequest) -> None:
    check_id(request.id, "id")
    file = _check_file(request.file)
    if len(request.parts) > MAX_ADDRESSES:
        raise ContractError(f"parts must be at most {MAX_ADDRESSES}, got {len(request.parts)}")
    for part, sha256 in request.parts.items():
        part_range(file, part)
        check_sha256(sha256, f"SHA-256 of part {part}")
    if request.parts_sha256 is not None:
        check_sha256(request.parts_sha256, "parts_sha256")


encode_file_request, decode_file_request = codec(
    FileRequest, "file request", _check_file_request, file=partial(read, File), parts=_parts
)


def _check_file(file: File) -> File:
    checked(_FILE_NAME, file.name, "file name", "up to 4 levels of A-Z a-z 0-9 . _ -, up to 100 each")
    if file.kind not in KINDS:
        raise ContractError(f"kind must be one of {', '.join(KINDS)}, got {shown(file.kind)}")
    checked(_CONTENT_TYPE, file.content_type, "content type", "type/subtype in lower case")
    check_sha256(file.sha256)
    whole_number("size", file.size, 0, MAX_FILE_BYTES)
    if check_time(file.t_us, "file time") < 0:
        raise ContractError(f"file time must be from 1970 on, got {file.t_us}")
    return file
