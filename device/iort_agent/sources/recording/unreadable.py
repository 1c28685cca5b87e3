"""What is wrong with a recording that cannot be read, and what to do about it."""

from __future__ import annotations

import traceback
from contextlib import contextmanager
from pathlib import Path
from typing import Iterator

from iort_agent.errors import SourceError

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
    """Raise `SourceError` for a file whose suffix is of another kind than its content."""
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise SourceError(f"{path}: cannot be opened: {error.strerror}") from error
    for magic, suffix, what in _KINDS:
        if head.startswith(magic) and path.suffix != suffix:
            raise SourceError(f"{path}: is {what} by its content: rename it to {path.stem}{suffix}")


class TooLargeError(Exception):
    """Something in a recording is larger than it may be."""


@contextmanager
def wrapped(what: str) -> Iterator[None]:
    """Turn every error of a bag library into `SourceError`, because damaged files raise anything."""
    try:
        yield
    except SourceError:
        raise
    except TooLargeError as error:
        raise SourceError(f"{what.partition(': ')[0]}: {error}") from error
    except Exception as error:
        if isinstance(error, MemoryError):
            raise SourceError(f"{what}: a record claims to be larger than the memory") from error
        if isinstance(error, _WORDLESS):
            line = traceback.extract_tb(error.__traceback__)[-1].line
            raise SourceError(
                f"{what}: its records do not fit together: {type(error).__name__} at `{line}`; {_COPIED}"
            ) from error
        advice = next((f"; {what}" for sign, what in _ADVICE if sign in str(error)), "")
        text = " ".join(str(error).split())
        text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
        raise SourceError(f"{what}: {type(error).__name__}: {text}{advice}") from error
