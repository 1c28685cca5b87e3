"""Reads a recording from its start to where it is good, without its index: one that was cut off, was not
closed, or is an MCAP of another profile than ROS 2's, which rosbags does not read."""

from __future__ import annotations

import struct
from collections import Counter
from contextlib import closing
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Callable, Iterator, Mapping, NamedTuple, Sequence, Tuple

from iort_contract.recordings import RecordingError
from iort_contract.recordings.files import INDEX, MAX_INFLATED, TooLargeError, inflated

_U16, _U32, _U64 = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<Q")
_RECORD = struct.Struct("<BQ")
_MCAP_MESSAGE = struct.Struct("<HIQQ")
_MCAP_MAGIC, _BAG_MAGIC = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
# The encodings of schemas whose definition can be read.
_ROS1, _ROS2 = "ros1msg", ("ros2msg", "ros2idl")


class _CutError(Exception):
    """The file ends within a record, or holds something else from here on."""


# What reading damaged records raises.
_DAMAGED = (_CutError, KeyError, ValueError, struct.error, EOFError, RuntimeError, TooLargeError)


class Found(NamedTuple):
    """A connection, with the names that rosbags gives its own."""

    id: int
    topic: str
    msgtype: str
    msgdef: str
    digest: str
    ros2: bool


_Message = Tuple[Found, int, bytes]


class Scan:
    """A recording as `iort_contract.recordings.files.Reader` gives it. It is read twice, first to be counted.

    ``end`` says where it stops being good; empty for one that is whole. ``skipped`` has the topics whose
    messages are not ROS', with their encoding.
    """

    def __init__(self, path: Path) -> None:
        self._paths = [path]
        if path.is_dir():
            self._paths = sorted(one for one in path.iterdir() if one.suffix in (".mcap", ".db3"))
            if not self._paths:
                raise RecordingError(
                    f"{path}: a folder of ROS 2 has .mcap or .db3 files, and this one has none"
                )
        self.start_ns = self.end_ns = 0
        self.end = ""
        self.skipped: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._there: dict[tuple[Any, ...], Found] = {}

    def open(self) -> None:
        """Count everything, unless it is counted already."""
        if self._there:
            return
        first, last = 2**63, -1
        for found, t_ns, _ in self.messages(lambda _: True):
            self._there[found] = found
            self._counts[found.topic] += 1
            first, last = min(first, t_ns), max(last, t_ns)
        self.start_ns, self.end_ns = (first, last) if last >= 0 else (0, 0)

    def close(self) -> None:
        """Nothing stays open."""

    @property
    def connections(self) -> Sequence[Found]:
        """The connections that have messages."""
        return list(self._there.values())

    def type_hash(self, connection: Found) -> str:
        """The recorded hash of a connection's type; empty if there is none."""
        return connection.digest

    def ros2(self, connection: Found) -> bool:
        """Whether a connection has messages of ROS 2."""
        return connection.ros2

    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """As the reader's: what was counted is all that there is to compare with."""
        return {INDEX: dict(self._counts)}

    def messages(self, wanted: Callable[[Found], bool]) -> Iterator[_Message]:
        """The messages of the wanted connections, in the order of the file."""
        path = self._paths[0]
        try:
            for path in self._paths:
                for message in _FORMATS[_kind(path)](self, path):
                    if wanted(message[0]):
                        yield message
        except _CutError as error:
            self.end = str(error)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error


def _kind(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise RecordingError(f"{path}: is empty: was it copied whole?")
    kind = next((magic for magic in _FORMATS if head.startswith(magic)), None)
    if kind is None:
        raise RecordingError(
            f"{path}: is no recording by its first bytes: it must be a .bag of ROS 1, a .db3 or .mcap, a "
            "folder of ROS 2 with these, or a .csv of VESC Tool"
        )
    return kind


# ROS 1: https://wiki.ros.org/Bags/Format/2.0

_CHUNK, _CONNECTION, _DATA = 5, 7, 2


def _bag(_scan: Scan, path: Path) -> Iterator[_Message]:
    known: dict[int, Found] = {}
    with path.open("rb") as file:
        size = path.stat().st_size
        file.seek(len(_BAG_MAGIC))
        while file.tell() < size:
            at = file.tell()
            try:
                header = _bag_header(_sized(file, size))
                is_chunk = header.get("op") == bytes([_CHUNK])
                data = _sized(file, size, within=is_chunk)
                if is_chunk:
                    # The last one may end early.
                    yield from _bag_chunk(_inflated(header["compression"].decode(), data), known)
                elif header.get("op") == bytes([_CONNECTION]):
                    _bag_connection(header, data, known)
            except (
                _CutError,
                KeyError,
                ValueError,
                struct.error,
                EOFError,
                RuntimeError,
                TooLargeError,
            ) as error:
                raise _cut(path, at, size, error) from error


def _bag_header(head: bytes) -> dict[str, bytes]:
    header, at = {}, 0
    while at < len(head):
        (n,) = _U32.unpack_from(head, at)
        name, found, value = head[at + 4 : at + 4 + n].partition(b"=")
        if not found:
            raise ValueError("no header")
        header[name.decode()] = value
        at += 4 + n
    return header


def _sized(file: BinaryIO, size: int, *, within: bool = False) -> bytes:
    """A length and its bytes; with ``within``, as many of them as there are."""
    head = file.read(4)
    if len(head) < 4:
        raise _CutError
    (n,) = _U32.unpack(head)
    room = size - file.tell()
    if n > room and not within:
        raise _CutError
    # What a record claims may be more than the memory.
    return file.read(min(n, room))


def _inflated(compression: str, data: bytes) -> bytes:
    """A chunk's records; of one that ends early, those that are there."""
    if compression in ("", "none"):
        return data
    parts, room = [], MAX_INFLATED
    for part in _parts(compression, data):
        room -= len(part)
        if room < 0:
            raise TooLargeError(f"a chunk inflates to more than {MAX_INFLATED:,} bytes")
        parts.append(part)
    return b"".join(parts)


def _parts(compression: str, data: bytes) -> Iterator[bytes]:
    try:
        yield from inflated(compression, iter([data]))
    except EOFError:
        return
    except Exception as error:
        # Each library raises its own.
        raise ValueError(f"{compression} cannot be inflated: {error}") from error


def _bag_chunk(data: bytes, known: dict[int, Found]) -> Iterator[_Message]:
    chunk = BytesIO(data)
    while chunk.tell() < len(data):
        header, content = _bag_header(_sized(chunk, len(data))), _sized(chunk, len(data))
        if header["op"] == bytes([_CONNECTION]):
            _bag_connection(header, content, known)
        elif header["op"] == bytes([_DATA]):
            sec, nsec = struct.unpack("<II", header["time"])
            yield known[_U32.unpack(header["conn"])[0]], sec * 1_000_000_000 + nsec, content


def _bag_connection(header: Mapping[str, bytes], data: bytes, known: dict[int, Found]) -> None:
    (number,) = _U32.unpack(header["conn"])
    if number in known:
        return
    about, at = {}, 0
    while at < len(data):
        (n,) = _U32.unpack_from(data, at)
        name, _, value = data[at + 4 : at + 4 + n].partition(b"=")
        about[name.decode()] = value.decode("utf-8", "replace")
        at += 4 + n
    topic = header["topic"].decode()
    known[number] = Found(
        number, topic, about["type"], about["message_definition"], about.get("md5sum", ""), ros2=False
    )


# MCAP: https://mcap.dev/spec

_SCHEMA, _CHANNEL, _MESSAGE, _MCAP_CHUNK, _DATA_END = 3, 4, 5, 6, 15


def _mcap(scan: Scan, path: Path) -> Iterator[_Message]:
    schemas: dict[int, tuple[str, str, bytes]] = {}
    channels: dict[int, Any] = {}
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(len(_MCAP_MAGIC))
        while True:
            at = file.tell()
            try:
                kind, data = _mcap_record(file, size, within=True)
                if kind == _DATA_END:
                    return
                if kind != _MCAP_CHUNK:
                    yield from _mcap_content(scan, kind, data, schemas, channels)
                    continue
                chunk = BytesIO(data)
                chunk.seek(28)
                compression = _text(chunk)
                (n,) = _U64.unpack(chunk.read(8))
                records = chunk.read(min(n, len(data)))
                inside = _inflated(compression, records)
                messages = BytesIO(inside)
                found: list[_Message] = []
                try:
                    while messages.tell() < len(inside):
                        found += _mcap_content(scan, *_mcap_record(messages, len(inside)), schemas, channels)
                finally:
                    # Of the last chunk, which may end early, what there is.
                    yield from sorted(found, key=lambda one: one[1])
            except _DAMAGED as error:
                raise _cut(path, at, size, error) from error


def _mcap_record(file: BinaryIO, size: int, *, within: bool = False) -> tuple[int, bytes]:
    """A record's kind and content; with ``within``, of a chunk as much as there is."""
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        raise _CutError
    kind, n = _RECORD.unpack(head)
    room = size - file.tell()
    if n > room and not (within and kind == _MCAP_CHUNK):
        raise _CutError
    return kind, file.read(min(n, room))


def _mcap_content(
    scan: Scan, kind: int, data: bytes, schemas: dict[int, tuple[str, str, bytes]], channels: dict[int, Any]
) -> Iterator[_Message]:
    if kind == _MESSAGE:
        channel, _, log_ns, _ = _MCAP_MESSAGE.unpack_from(data)
        found = channels[channel]
        if found is not None:
            yield found, log_ns, data[_MCAP_MESSAGE.size :]
        return
    record = BytesIO(data)
    if kind == _SCHEMA:
        (number,) = _U16.unpack(record.read(2))
        schemas[number] = _text(record), _text(record), record.read(_U32.unpack(record.read(4))[0])
    elif kind == _CHANNEL:
        number, of = struct.unpack("<HH", record.read(4))
        topic, encoding = _text(record), _text(record)
        name, form, definition = schemas.get(of, ("", "", b""))
        if number in channels:
            return
        if form != _ROS1 and form not in _ROS2:
            scan.skipped[topic] = form or encoding
            channels[number] = None
            return
        end = record.tell() + 4 + _U32.unpack(record.read(4))[0]
        about = {}
        while record.tell() < end:
            key = _text(record)
            about[key] = _text(record)
        digest = about.get("topic_type_hash", "") if form in _ROS2 else about.get("md5sum", "")
        text = definition.decode("utf-8", "replace")
        channels[number] = Found(number, topic, name, text, digest, ros2=form in _ROS2)


def _text(record: BinaryIO) -> str:
    content = record.read(_U32.unpack(record.read(4))[0])
    return content.decode("utf-8", "replace")


# A database of ROS 2.


def _db3(_scan: Scan, path: Path) -> Iterator[_Message]:
    sqlite, size, read = import_module("apsw"), path.stat().st_size, 0

    class File(sqlite.VFSFile):  # type: ignore[misc, name-defined]  # a library without types for us
        """A page that is not in the file would read as zeros, without an error."""

        def xRead(self, amount: int, offset: int) -> bytes:  # noqa: N802 - SQLite's name
            if offset + amount > size:
                raise sqlite.IOError("the file ends there")
            return bytes(super().xRead(amount, offset))

    class Files(sqlite.VFS):  # type: ignore[misc, name-defined]  # as above
        def __init__(self) -> None:
            super().__init__(_VFS, "")

        def xOpen(self, name: Any, flags: Any) -> Any:  # noqa: N802 - as above
            return File("", name, flags)

    files, flags = Files(), sqlite.SQLITE_OPEN_READONLY | sqlite.SQLITE_OPEN_URI
    try:
        with closing(sqlite.Connection(f"{path.absolute().as_uri()}?immutable=1", flags, _VFS)) as database:
            # SQLite refuses a file that is shorter than it says, otherwise.
            database.execute("PRAGMA writable_schema=ON")
            hashed = any(
                "type_description_hash" in row for row in database.execute("PRAGMA table_info(topics)")
            )
            known = {}
            definitions = dict(database.execute(_DEFINITIONS)) if hashed else {}
            digest = "type_description_hash" if hashed else "''"
            for number, topic, kind, said in database.execute(f"SELECT id, name, type, {digest} FROM topics"):  # noqa: S608 - ours
                known[number] = Found(number, topic, kind, definitions.get(kind, ""), said, ros2=True)
            for number, t_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages"):
                read += 1
                yield known[number], t_ns, data
    except (sqlite.Error, KeyError) as error:
        raise _CutError(f"{path}: good for its first {read:,} messages, then: {error}") from error
    finally:
        files.unregister()


_VFS = "iort"
_DEFINITIONS = "SELECT topic_type, encoded_message_definition FROM message_definitions"


def _cut(path: Path, at: int, size: int, error: Exception) -> _CutError:
    why = "it ends there within a record" if isinstance(error, _CutError) else f"there is no record: {error}"
    return _CutError(f"{path}: good until byte {at:,} of {size:,}: {why}")


_FORMATS: Mapping[bytes, Callable[[Scan, Path], Iterator[_Message]]] = {
    _MCAP_MAGIC: _mcap,
    _BAG_MAGIC[:9]: _bag,
    b"SQLite format 3\0": _db3,
}
