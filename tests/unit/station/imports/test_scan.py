"""Recordings without an index, that were cut off, or of a profile that the library does not read."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from iort_contract.recordings import RecordingError
from iort_contract.recordings.files import INDEX, Reader
from iort_contract.recordings.rosbag import Recording, Unread
from iort_contract.recordings.scan import Scan
from testkit.bags import STREAMS, TOPICS, written

SECONDS = 3.0
MCAP, BAG = b"\x89MCAP0\r\n", b"#ROSBAG V2.0\n"
ALL = sum(int(SECONDS * topic.hz) for topic in TOPICS)


def read(path: Path, reader: Reader | Scan | None = None) -> tuple[list[tuple[str, int, int, bytes]], Unread]:
    """The messages, without what says what they are made of."""
    unread = Unread()
    with Recording(path, tuple(STREAMS.items()), "vesc", unread, reader=reader) as messages:
        found = [(one.stream, one.at_ns, one.stamp_ns, getattr(one.values, "raw", b"")) for one in messages]
    return [one for one in found if one[0] in STREAMS.values()], unread


def made(folder: Path, kind: str) -> tuple[Path, Path]:
    """A recording, and the file in it."""
    path = folder / f"drive.{kind}" if kind == "bag" else folder / "drive"
    assert written(path, kind, seconds=SECONDS) == ALL
    return path, path if kind == "bag" else next(one for one in path.iterdir() if one.suffix != ".yaml")


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_a_scan_gives_what_the_index_gives(tmp_path: Path, kind: str) -> None:
    path, file = made(tmp_path, kind)
    scan = Scan(file)
    found, unread = read(file, scan)
    by_index, _ = read(path)
    assert sorted(found) == sorted(by_index)
    assert (len(found), scan.end, scan.skipped, unread.lines) == (ALL, "", {}, {})


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_folder_without_its_metadata_is_read_by_its_files(tmp_path: Path, kind: str) -> None:
    path, _ = made(tmp_path, kind)
    (path / "metadata.yaml").unlink()
    assert len(read(path, Scan(path))[0]) == ALL


def test_an_mcap_of_ros_1_is_read(tmp_path: Path) -> None:
    bag, mcap = tmp_path / "a.bag", tmp_path / "a.mcap"
    written(bag, "bag", seconds=SECONDS)
    written(mcap, "mcap of ROS 1", seconds=SECONDS)
    with pytest.raises(RecordingError, match="Profile is not ros2"):
        read(mcap)
    assert sorted(read(mcap, Scan(mcap))[0]) == sorted(read(bag)[0])


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
def test_what_was_cut_off_is_read_until_there(tmp_path: Path, kind: str, share: float) -> None:
    path, file = made(tmp_path, kind)
    whole = {(stream, stamp_ns, raw) for stream, _, stamp_ns, raw in read(path)[0]}
    content = file.read_bytes()
    (cut := tmp_path / f"cut{file.suffix}").write_bytes(content[: int(share * len(content))])
    with pytest.raises(RecordingError):
        read(cut)
    scan = Scan(cut)
    found = [(stream, stamp_ns, raw) for stream, _, stamp_ns, raw in read(cut, scan)[0]]
    assert set(found) < whole
    assert len(found) == len(set(found))
    # Half of what is there, at least; a database has its pages in no order.
    assert len(found) > (0 if kind == "db3" else share * ALL / 2)
    assert str(cut) in scan.end


def test_a_bag_without_an_index_is_whole(tmp_path: Path) -> None:
    path, _ = made(tmp_path, "bag")
    content = bytearray(path.read_bytes())
    # As `rosbag record` leaves it that was killed: the head says that there is no index.
    at = content.index(b"index_pos=") + len(b"index_pos=")
    end = int.from_bytes(content[at : at + 8], "little")
    content[at : at + 8] = bytes(8)
    path.write_bytes(content[:end])
    with pytest.raises(RecordingError, match="rosbag reindex"):
        read(path)
    scan = Scan(path)
    assert (len(read(path, scan)[0]), scan.end) == (ALL, "")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "is empty: was it copied whole?"),
        (b"no recording at all", "is no recording by its first bytes"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes, problem: str) -> None:
    (path := tmp_path / "a.bag").write_bytes(content)
    with pytest.raises(RecordingError, match=problem):
        Scan(path).open()


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"has \.mcap or \.db3 files, and this one has none"):
        Scan(tmp_path)


def _chunk(kind: str, said: bytes) -> bytes:
    """A chunk of MCAP, or of a bag, that says that it is compressed so."""
    if kind == "bag":
        head = b"".join(struct.pack("<I", len(one)) + one for one in (b"op=\5", b"compression=" + said))
        return struct.pack("<I", len(head)) + head + struct.pack("<I", 40) + bytes(range(40))
    return (
        struct.pack("<BQ28xI", 6, 60 + len(said), len(said))
        + said
        + struct.pack("<Q20s", 20, bytes(range(20)))
    )


@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        *[("mcap", MCAP + _chunk("mcap", kind)) for kind in (b"zstd", b"lz4", b"bz2", b"none at all")],
        *[("bag", BAG + _chunk("bag", kind)) for kind in (b"zstd", b"lz4", b"bz2", b"none at all")],
        # Larger than any memory, and than any number.
        *[("mcap", MCAP + struct.pack("<BQ", 6, size) + bytes(50)) for size in (2**62, 2**64 - 1)],
        ("mcap", MCAP + struct.pack("<BQ28xI4sQ", 6, 44, 4, b"zstd", 2**64 - 1)),
        ("bag", BAG + struct.pack("<I", 2**32 - 1) + b"x"),
    ],
)
def test_what_no_record_can_be_ends_the_recording(tmp_path: Path, suffix: str, content: bytes) -> None:
    (path := tmp_path / f"a.{suffix}").write_bytes(content)
    (scan := Scan(path)).open()
    assert (scan.connections, scan.counts()) == ([], {INDEX: {}})
    assert f"{path}: good until byte " in scan.end
