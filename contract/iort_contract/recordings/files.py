"""Opens the bags of ROS 1 and ROS 2 with the package rosbags, and reads their messages as they were stored.

Nothing is left out in silence: `Reader.counts` has what the files and metadata.yaml say that they hold. The
files of a ROS 2 folder are read each by its own index, because the library skips the connections that
metadata.yaml describes in other words. A chunk or message may inflate to `MAX_INFLATED` bytes, since a few
bytes can stand for gigabytes.
"""

from __future__ import annotations

import bz2
import re
import shutil
import tempfile
import traceback
from collections import Counter
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping, Sequence

from iort_contract.recordings import RecordingError

# The first bytes of a file, its usual suffix, and its kind.
_KINDS = (
    (b"\x89MCAP0\r\n", ".mcap", "MCAP"),
    (b"#ROSBAG V", ".bag", "a bag of ROS 1"),
    (b"SQLite format 3\0", ".db3", "a database of ROS 2"),
)
_INDEX = "`rosbag reindex` mends a recording that was cut off"
_CUT_OFF = "the file was cut off: `mcap recover IN.mcap -o OUT.mcap` saves its messages"
_CUT_OFF_SQLITE = "the file was cut off: `sqlite3 IN.db3 .recover | sqlite3 OUT.db3` saves its messages"
_REINDEX = "`ros2 bag reindex FOLDER` writes its metadata.yaml; or name the .mcap or .db3 file in it"
_FOLDER = f"a folder of ROS 2 has a metadata.yaml: {_REINDEX}"
_SERVICES = (
    "it holds service events, whose definitions cannot be read: leave them out, "
    "`mcap filter IN.mcap -o OUT.mcap --exclude-topic-regex '.*/_service_event'`"
)
_COPIED = "compare the file with its original, or repair it as a recording that was cut off"
# A part of rosbags' error, and what to do about it.
_ADVICE = (
    ("index looks damaged", _INDEX),
    ("Bag is not indexed", _INDEX),
    ("Profile is not ros2", "a recording of ROS 1 is read as .bag only"),
    ("File end magic is invalid", _CUT_OFF),
    ("Truncated record", _CUT_OFF),
    ("Invalid MCAP footer", _CUT_OFF),
    ("File magic is invalid", "it does not begin as a recording does: was it copied whole?"),
    ("Expected metadata file", _FOLDER),
    # The newest rosbags for Python 3.8 takes the folder for a file.
    ("Is a directory", _FOLDER),
    ("Could not load YAML", _REINDEX),
    ("Could not read metadata", _REINDEX),
    ("metadata key is missing", _REINDEX),
    ("Invalid bag metadata", _REINDEX),
    ("disk image is malformed", _CUT_OFF_SQLITE),
    ("Unrecognized storage format", "it must be .bag, .mcap, .db3, .csv, or a folder of ROS 2"),
    ("SRV: ", _SERVICES),
)
# These say nothing without the line that raised them.
_WORDLESS = (AssertionError, KeyError, IndexError, TypeError, AttributeError)
# The library puts whole message definitions into its errors.
_LONGEST = 200


def check_kind(path: Path) -> None:
    """Raise `RecordingError` for a file whose suffix is of another kind than its content."""
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be opened: {error.strerror}") from error
    for magic, suffix, what in _KINDS:
        if head.startswith(magic) and path.suffix != suffix:
            raise RecordingError(f"{path}: is {what} by its content: rename it to {path.stem}{suffix}")


class TooLargeError(Exception):
    """Something in a recording is larger than it may be."""


@contextmanager
def wrapped(what: str) -> Iterator[None]:
    """Turn every error of a bag library into `RecordingError`, because damaged files raise anything."""
    try:
        yield
    except RecordingError:
        raise
    except TooLargeError as error:
        raise RecordingError(f"{what.partition(': ')[0]}: {error}") from error
    except Exception as error:
        if isinstance(error, MemoryError):
            raise RecordingError(f"{what}: a record claims to be larger than the memory") from error
        if isinstance(error, _WORDLESS):
            line = traceback.extract_tb(error.__traceback__)[-1].line
            raise RecordingError(
                f"{what}: its records do not fit together: {type(error).__name__} at `{line}`; {_COPIED}"
            ) from error
        advice = next((f"; {what}" for sign, what in _ADVICE if sign in str(error)), "")
        text = " ".join(str(error).split())
        text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
        raise RecordingError(f"{what}: {type(error).__name__}: {text}{advice}") from error


def library(module: str) -> Any:
    """A module of rosbags, which the contract does not need: whoever reads bags brings it. Raises
    `RecordingError` without it."""
    try:
        return import_module(f"rosbags.{module}")
    except ImportError as error:
        raise RecordingError(f"reading a bag needs the package rosbags: {error}") from error


# Recorders write chunks of about a megabyte; a chunk is larger only for a message that is.
MAX_INFLATED = 64 * 1024 * 1024
_READ = 1024 * 1024
# Where a file counts what it holds.
INDEX = "the index"
_RIHS01 = re.compile(rb"RIHS01_[0-9a-f]{64}")


class Reader:
    """A recording, open for reading. The library's errors come as `RecordingError`."""

    def __init__(self, path: Path) -> None:
        check_kind(path)
        # The library for Python 3.8 opens folders only, and people name the file in it.
        in_folder = path.suffix in (".db3", ".mcap") and (path.parent / "metadata.yaml").exists()
        self._path, self._file = path, path.parent if in_folder else path
        self.is2 = path.suffix != ".bag"
        self._parts: list[Any] = []

    def open(self) -> None:
        """Open all files and read their indexes."""
        if self.is2:
            _bound_mcap()
            if _zstd() is not None:
                self._check_room()
        with wrapped(f"{self._path}: cannot be opened"):
            self._reader: Any = library("rosbag2" if self.is2 else "rosbag1").Reader(self._file)
            self._reader.open()
        if not self.is2:
            _bound_bag(self._reader.chunks)
        # A file, the files of a folder, or all that the library for Python 3.8 has.
        storage = getattr(self._reader, "storage", self._reader)
        self._parts = list(getattr(storage, "storages", [self._reader]))

    def close(self) -> None:
        """Close all files."""
        self._reader.close()

    @property
    def start_ns(self) -> int:
        """The time of the first message."""
        parts = (part if hasattr(part, "start_time") else part.metadata for part in self._parts)
        return min(int(part.start_time) for part in parts)

    @property
    def end_ns(self) -> int:
        """The time of the last message."""
        parts = (part if hasattr(part, "end_time") else part.metadata for part in self._parts)
        return max(int(part.end_time) for part in parts) - 1

    @property
    def connections(self) -> list[Any]:
        """What the library knows of each connection of the files."""
        return [connection for part in self._parts for connection in part.connections]

    def type_hash(self, connection: Any) -> str:
        """The recorded hash of a connection's type: MD5, or ROS 2's RIHS01. Empty if there is none."""
        if connection.digest:
            return str(connection.digest)
        # The library leaves out what MCAP says beside a channel; metadata.yaml may say it, too.
        channel = getattr(connection.owner, "channels", {}).get(connection.id)
        found = _RIHS01.search(getattr(channel, "metadata", b""))
        if found:
            return found.group().decode()
        same = (connection.topic, connection.msgtype)
        return next((c.digest for c in self._reader.connections if (c.topic, c.msgtype) == same), "")

    def ros2(self, _connection: Any) -> bool:
        """Whether a connection has messages of ROS 2."""
        return self.is2

    def counts(self) -> Mapping[str, Mapping[str, int]]:
        """Where messages are counted -> topic -> the number of its messages."""
        counts = {INDEX: _counts(self.connections)}
        if not self.is2:
            counts["the list of chunks"] = {name: info.msgcount for name, info in self._reader.topics.items()}
        elif self._file.is_dir():
            counts["metadata.yaml"] = _counts(self._reader.connections)
        return counts

    def messages(self, wanted: Callable[[Any], bool]) -> Iterator[tuple[Any, int, bytes]]:
        """The messages of the wanted connections: connection, time of recording, and bytes as published."""
        mode = getattr(self._reader, "compression_mode", None) if self.is2 else None
        for part in self._parts:
            connections = [connection for connection in part.connections if wanted(connection)]
            if not connections:
                continue
            # The library inflates them itself only if it reads the folder as a whole.
            inflates = mode == "message" and part is not self._reader
            # What whoever takes a message raises does not come here.
            with wrapped(f"{self._path}: is damaged"):
                for connection, t_ns, raw in part.messages(connections):
                    yield connection, t_ns, inflate("zstd", raw) if inflates else bytes(raw)

    def _check_room(self) -> None:
        """Refuse files that would fill the disk when the library inflates them, into a temporary folder."""
        files = sorted(self._file.glob("*.zst*")) if self._file.is_dir() else []
        room = shutil.disk_usage(tempfile.gettempdir()).free // 2 if files else 0
        for path in files:
            with wrapped(f"{path}: cannot be inflated"), path.open("rb") as file:
                for data in inflated("zstd", iter(lambda: file.read(_READ), b"")):
                    room -= len(data)
                    if room < 0:
                        raise RecordingError(
                            f"{path}: inflates to more than half of what is free in {tempfile.gettempdir()}"
                        )


def inflate(kind: str, data: bytes) -> bytes:
    """Inflate a chunk or a message; raises `TooLargeError` beyond `MAX_INFLATED`."""
    parts, room = [], MAX_INFLATED
    for part in inflated(kind, iter([data])):
        room -= len(part)
        if room < 0:
            raise TooLargeError(
                f"a chunk of {len(data):,} bytes inflates to more than {MAX_INFLATED:,}: write the recording "
                "again, in smaller chunks"
            )
        parts.append(part)
    return parts[0] if len(parts) == 1 else b"".join(parts)


def inflated(kind: str, pieces: Iterator[bytes]) -> Iterator[bytes]:
    """Inflate data a part at a time; ``kind`` is bz2, lz4 or zstd. Raises `EOFError` if it ends early."""
    one: Any = None
    for data in pieces:
        while data or (one is not None and not one.needs_input):
            # What follows the end of a frame is another one.
            one = _decompressor(kind) if one is None else one
            part = one.decompress(data, MAX_INFLATED + 1)
            data = b""  # noqa: PLW2901 - the rest is in the decompressor
            if part:
                yield part
            if one.eof:
                data, one = one.unused_data or b"", None  # noqa: PLW2901 - as above
    if one is not None:
        raise EOFError("compressed data ended before its end-of-stream marker")


def _decompressor(kind: str) -> Any:
    """A decompressor of the standard library's kind; all three are used alike."""
    if kind == "bz2":
        return bz2.BZ2Decompressor()
    if kind == "lz4":
        return import_module("lz4.frame").LZ4FrameDecompressor()
    return _zstd().ZstdDecompressor()


def _zstd() -> Any:
    """The module that the library itself uses; None for Python 3.8, whose own cannot be bounded."""
    return getattr(library("rosbag2.storage_mcap"), "zstd", None)


def _bound_mcap() -> None:
    """Let the library inflate the chunks of MCAP within the bound, by its table of compressions."""
    decompressors = library("rosbag2.storage_mcap").DECOMPRESSORS
    for kind in ("lz4", "zstd"):
        if kind != "zstd" or _zstd() is not None:
            decompressors[kind] = lambda data, _size, kind=kind: inflate(kind, data)


def _bound_bag(chunks: dict[int, Any]) -> None:
    """Let the library inflate the chunks of ROS 1 within the bound."""
    decompress = import_module("lz4.frame").decompress
    for at, chunk in chunks.items():
        for kind, unbounded in (("bz2", bz2.decompress), ("lz4", decompress)):
            if chunk.decompressor is unbounded:
                chunks[at] = chunk._replace(decompressor=lambda data, kind=kind: inflate(kind, data))


def _counts(connections: Sequence[Any]) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for connection in connections:
        counts[connection.topic] += connection.msgcount
    return dict(counts)
