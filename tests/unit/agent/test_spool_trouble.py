"""The spool on disk where the disk does not work or the file is damaged: numbers are never used twice."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from iort_agent.errors import AgentError
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.reservation import BLOCK, BLOCK_ADRIFT
from tests.agent_fakes import ManualClock
from tests.unit.agent.test_spool import fill, following, kept
from tests.unit.agent.test_sqlite_spool import MB, ROOT, all_kept, crash, running, spool_at


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.db"


# --- disks that do not work ------------------------------------------------------------------------


def test_a_full_disk_leaves_it_running_in_memory_until_there_is_room(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = spool_at(path, max_file_bytes=256 * 1024, memory_bytes=100_000)
    published: dict[int, bytes] = {}
    for _ in range(20):
        fill(spool, 50, size=1000)
        spool.flush()
    assert not spool.flush()
    assert "database or disk is full" in (spool.alarm or "")
    assert caplog.text.count("disk is full") == 1, "raised once"
    assert not spool.durable
    fill(spool, 200, size=1000)
    dropped = spool.dropped()
    assert dropped.batches > 0, "what memory has no room for"
    assert 90_000 < sum(map(len, (e.payload for e in spool._stock.pending.values()))) <= 100_000
    seqs = kept(spool)
    assert seqs == sorted(seqs)
    assert len(seqs) == 1200 - dropped.batches == spool.backlog().batches
    for entry in all_kept(spool):
        published[entry.seq] = entry.payload
    # A kill now: the database does not know all the numbers that were used.
    again = spool_at(crash(spool, tmp_path), max_file_bytes=256 * 1024, memory_bytes=100_000)
    assert again.next_seq("vesc") > max(published)
    assert again.next_seq("vesc") <= 1200 + BLOCK_ADRIFT
    fill(again, 50, size=1000)
    again.flush()
    assert again.alarm is not None
    for entry in all_kept(again):
        again.ack(entry.id)
    fill(again, 5, size=1000)
    assert again.flush(), "with room, what is in memory is written"
    assert again.alarm is None
    seq = again.next_seq("vesc")
    again.close()
    with running(again._path) as third:
        assert len(kept(third)) == 5
        assert third.next_seq("vesc") == seq


def test_a_disk_that_fails_at_the_start_is_taken_into_use_when_it_works(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 3)
    missing = path.parent / "away"
    path.parent.joinpath("disk").mkdir()
    spool = spool_at(missing / "spool.db")
    assert "kept in memory only" in (spool.alarm or "")
    fill(spool, 4)
    assert kept(spool) == [0, 1, 2, 3], "published from memory"
    spool.ack(1)
    missing.mkdir()
    for file in path.parent.glob("spool.db*"):
        shutil.copy(file, missing)
    assert spool.flush()
    assert spool.alarm is None
    assert spool.next_seq("vesc") == 4
    fill(spool, 1)
    assert kept(spool) == [1, 2, 3, 0, 1, 2, 4], "what was on the disk is sent too"
    spool.close()


LIMITED = """
import resource, sys
from pathlib import Path
from iort_agent.clock import SystemClock
from iort_agent.spool.sqlite import SqliteSpool

spool = SqliteSpool(Path(sys.argv[1]), max_bytes=2**30, clock=SystemClock())
spool.start()
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
for seq in range(1000):
    spool.put("vesc", seq, b"x" * 1000, samples=1)
assert not spool.flush()
assert spool.alarm is not None and "disk" in spool.alarm, spool.alarm
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
assert spool.flush(), spool.alarm
assert spool.alarm is None, spool.alarm
spool.close()
"""


def test_a_limit_of_the_operating_system_is_survived_too(path: Path) -> None:
    subprocess.run([sys.executable, "-c", LIMITED, str(path)], cwd=ROOT, check=True, timeout=60)
    with running(path, max_bytes=10 * MB) as spool:
        assert kept(spool) == list(range(1000))


# --- damage -------------------------------------------------------------------------------------------


def aside(path: Path) -> list[Path]:
    return [p for p in path.parent.glob("spool.db.corrupt-*") if not p.name.endswith(("-wal", "-shm"))]


def flip_pages(path: Path, pages: range) -> None:
    with path.open("r+b") as file:
        for page in pages:
            file.seek(page * 4096)
            old = file.read(4096)
            file.seek(page * 4096)
            file.write(bytes(byte ^ 0x55 for byte in old))


def test_garbage_is_set_aside_and_numbers_go_on_behind_the_reserved_ones(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 10)
    path.write_bytes(b"\0garbage" * 5000)
    with running(path) as spool:
        assert "damaged" in (spool.alarm or "")
        assert spool.next_seq("vesc") == 10 + BLOCK
        fill(spool, 1)
        assert kept(spool) == [10 + BLOCK]
    assert [file.read_bytes() for file in aside(path)] == [b"\0garbage" * 5000]
    with running(path) as spool:
        assert spool.alarm is None, "a good file at the next start is good"
        assert kept(spool) == [10 + BLOCK]


@pytest.mark.parametrize("stopped", [True, False])
def test_pages_flipped_in_the_middle_cost_only_what_was_in_them(path: Path, stopped: bool) -> None:
    spool = spool_at(path, max_bytes=10 * MB)
    fill(spool, 1, stream="rtt")
    spool.ack(following(spool, 0).id)
    for seq in range(2000):
        spool.put("vesc", seq, b"%01000d" % seq, samples=1)
    spool.flush()
    if stopped:
        spool.close()
    else:
        assert spool._disk.file is not None
        spool._disk.file._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        spool._disk.file._db.execute("PRAGMA cache_size = 0")
        spool._stock.window.clear()
    flip_pages(path, range(200, 210))
    if stopped:
        spool = spool_at(path, max_bytes=10 * MB)
    entries = all_kept(spool)
    assert all(int(entry.payload) == entry.seq for entry in entries), "nothing altered goes out"
    seqs = [entry.seq for entry in entries]
    assert seqs == sorted(set(seqs))
    assert 1800 < len(seqs) < 2000
    missing = 2000 - len(seqs)
    assert spool.backlog().batches == 2000 - missing
    if stopped:
        assert spool.dropped().batches <= missing, "of those that the index still knows"
    else:
        assert spool.dropped() == (missing, missing)
    assert "damaged" in (spool.alarm or "")
    assert len(aside(path)) == 1
    following_seq = spool.next_seq("vesc")
    assert spool.next_seq("rtt") == (1 + BLOCK if stopped else 1)
    assert following_seq == (2000 + BLOCK if stopped else 2000)
    fill(spool, 1)
    spool.close()
    with running(path, max_bytes=10 * MB) as again:
        assert kept(again) == [*seqs, following_seq]
        assert again.next_seq("rtt") == (1 + BLOCK if stopped else 1)


def test_a_payload_altered_on_the_disk_does_not_go_out(path: Path) -> None:
    with running(path) as spool:
        for i in range(10):
            spool.put("vesc", i, b"payload %d" % i * 10, samples=3)
    content = path.read_bytes()
    assert b"payload 4payload 4" in content
    path.write_bytes(content.replace(b"payload 4payload 4", b"payload 4payload 5", 1))
    with running(path) as spool:
        assert kept(spool) == [0, 1, 2, 3, 5, 6, 7, 8, 9]
        assert spool.dropped() == (1, 3)
        assert "is not as it was written" in (spool.alarm or "")
    assert len(aside(path)) == 1


@pytest.mark.parametrize("trouble", ["damaged", "damaged while it runs", "lost"])
def test_a_kill_while_a_new_file_is_begun_uses_no_number_twice(
    path: Path, trouble: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = spool_at(path)
    fill(spool, 10)
    spool.flush()
    if trouble != "damaged while it runs":
        spool.close()
        path.write_bytes(b"x" * 10_000) if trouble == "damaged" else path.unlink()

    def killed(*_: Any, **__: Any) -> None:
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(SpoolFile, "commit", killed)
        running_on = trouble == "damaged while it runs"
        with pytest.raises(SystemExit):
            spool._replace(sqlite3.DatabaseError("malformed")) if running_on else spool_at(path)
    spool._disk.close()
    assert path.exists(), "the new file is there, and empty"
    with running(path) as again:
        assert again.next_seq("vesc") >= 10
        assert again.alarm is None


def test_what_was_acknowledged_while_the_disk_was_full_does_not_come_again(path: Path) -> None:
    spool = spool_at(path)
    fill(spool, 5)
    spool.flush()
    assert spool._disk.file is not None
    commit = spool._disk.file.commit

    def full(*_: Any, **__: Any) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    spool._disk.file.commit = full
    for entry in all_kept(spool)[:3]:
        spool.ack(entry.id)
    assert not spool.flush()
    spool._disk.file.commit = commit
    assert spool.flush()
    spool.close()
    with running(path) as again:
        assert kept(again) == [3, 4]


def test_a_lost_database_does_not_reset_the_numbers(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 10)
        fill(spool, 1, stream="rtt")
    path.unlink()
    with running(path) as spool:
        assert (spool.next_seq("vesc"), spool.next_seq("rtt")) == (10 + BLOCK, 1 + BLOCK)


def test_a_file_removed_while_it_is_in_use_is_written_anew(path: Path, tmp_path: Path) -> None:
    spool = spool_at(path)
    fill(spool, 10)
    spool.flush()
    for file in path.parent.glob("spool.db*"):
        if not file.name.endswith(".seq"):
            file.unlink()
    fill(spool, 2)
    spool.flush()
    spool.flush()
    assert "removed" in (spool.alarm or "")
    # A kill, because the new file's log must be where it belongs.
    with running(crash(spool, tmp_path)) as again:
        assert kept(again) == list(range(12))
        assert again.next_seq("vesc") == 12


def test_only_the_newest_damaged_files_are_kept(path: Path) -> None:
    clock = ManualClock()
    for _ in range(6):
        with running(path, clock=clock) as spool:
            fill(spool, 1)
        path.write_bytes(b"x" * 10_000)
        clock.advance(1)
    assert len(aside(path)) == 3


@pytest.mark.parametrize("kind", ["text", "database"])
def test_a_file_that_is_none_of_ours_is_left_alone(path: Path, kind: str) -> None:
    if kind == "text":
        path.write_text("notes\n" * 100)
    else:
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.execute("CREATE TABLE mine (x)")
    before = path.read_bytes()
    for _ in range(2):
        with pytest.raises(AgentError, match=r"spool\.db: .*give queue\.path another name"):
            spool_at(path)
    assert path.read_bytes() == before
    assert not aside(path)


def test_a_newer_format_is_refused(path: Path) -> None:
    spool_at(path).close()
    with contextlib.closing(sqlite3.connect(path)) as db:
        db.execute("PRAGMA user_version = 2")
    with pytest.raises(AgentError, match="another version of iort-agent"):
        spool_at(path)


def test_a_second_agent_is_refused_and_told_what_to_do(path: Path) -> None:
    with running(path):
        code = (
            "import sys; from pathlib import Path; from iort_agent.clock import SystemClock\n"
            "from iort_agent.spool.sqlite import SqliteSpool\n"
            "SqliteSpool(Path(sys.argv[1]), max_bytes=1000, clock=SystemClock())"
        )
        second = subprocess.run(
            [sys.executable, "-c", code, str(path)], cwd=ROOT, capture_output=True, text=True, check=False
        )
    assert second.returncode == 1
    assert "spool.db.seq: the queue is in use by another iort-agent (process " in second.stderr
    assert "end that one, or give this robot a queue.path of its own" in second.stderr
    spool_at(path).close()
