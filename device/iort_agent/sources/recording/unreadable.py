"""What is wrong with a recording that cannot be read, and what to do about it."""

from __future__ import annotations

from pathlib import Path

from iort_agent.errors import SourceError

# How a file begins, whatever it is called; its usual ending; and what it is.
_KINDS = (
    (b"\x89MCAP0\r\n", ".mcap", "MCAP"),
    (b"#ROSBAG V", ".bag", "a bag of ROS 1"),
    (b"SQLite format 3\0", ".db3", "a database of ROS 2"),
)
_CUT_OFF = "the file was cut off: `mcap recover IN.mcap -o OUT.mcap` saves what is in it"
_REINDEX = "`ros2 bag reindex FOLDER` writes its metadata.yaml; or name the .mcap or .db3 file in it"
_SERVICES = (
    "it holds service events, whose definitions cannot be read: leave them out, "
    "`mcap filter IN.mcap -o OUT.mcap --exclude-topic-regex '.*/_service_event'`"
)
# What rosbags says, and what to do about it.
_ADVICE = (
    ("index looks damaged", "`rosbag reindex` mends a recording that was cut off"),
    ("Bag is not indexed", "`rosbag reindex` mends a recording that was cut off"),
    ("Profile is not ros2", "a recording of ROS 1 is read as .bag only"),
    ("File end magic is invalid", _CUT_OFF),
    ("Truncated record", _CUT_OFF),
    ("Invalid MCAP footer", _CUT_OFF),
    ("File magic is invalid", "it does not begin as a recording does: was it copied whole?"),
    ("Expected metadata file", f"a folder of ROS 2 has a metadata.yaml: {_REINDEX}"),
    # The newest rosbags for Python 3.8 takes such a folder for a file.
    ("Is a directory", f"a folder of ROS 2 has a metadata.yaml: {_REINDEX}"),
    ("Could not load YAML", _REINDEX),
    ("Could not read metadata", _REINDEX),
    ("metadata key is missing", _REINDEX),
    ("Invalid bag metadata", _REINDEX),
    (
        "disk image is malformed",
        "the file was cut off: `sqlite3 IN.db3 .recover | sqlite3 OUT.db3` saves what is in it",
    ),
    ("Unrecognized storage format", "allowed is .bag, .mcap, .db3, .csv, or a folder of ROS 2"),
    (
        "SRV: ",
        _SERVICES,
    ),
)
# The library puts whole definitions of messages into its errors.
_LONGEST = 200


def check_kind(path: Path) -> None:
    """Raise `SourceError` for a file whose name says that it is of another kind than it is."""
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


class Wrapped:
    """Turns whatever a bag library raises into `SourceError`: damaged files raise about anything."""

    def __init__(self, what: str) -> None:
        self._what = what

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        if isinstance(error, Exception) and not isinstance(error, SourceError):
            advice = next((f"; {what}" for sign, what in _ADVICE if sign in str(error)), "")
            said = " ".join(str(error).split())
            said = said if len(said) <= _LONGEST else f"{said[:_LONGEST]}..."
            raise SourceError(f"{self._what}: {type(error).__name__}: {said}{advice}") from error
