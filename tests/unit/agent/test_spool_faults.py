"""The spool on disk where the disk does not work, the file is damaged, or another process has it."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from iort_agent.errors import AgentError
from iort_agent.spool.file import SpoolFile
from testkit.agent import ManualClock
from tests.unit.agent.test_spool import (
    BOOT,
    MB,
    ROOT,
    RUNS,
    Failing,
    all_kept,
    crash,
    fill,
    following,
    kept,
    path,
    retry,
    running,
    spool_at,
    works,
)

__all__ = ["path", "works"]


# --- disks that do not work ------------------------------------------------------------------------


def test_the_oldest_in_a_full_file_are_dropped_and_counted_though_they_cannot_be_deleted(path: Path) -> None:
    spool = spool_at(path, max_bytes=100, open_file=Failing)
    fill(spool, 8)
    spool.work()
    Failing.commits = sqlite3.OperationalError("any text")
    fill(spool, 5, first=8)
    spool.work()
    assert spool.dropped() == (3, 15)
    assert spool.backlog() == (10, 50, 100)
    assert kept(spool) == list(range(3, 13))
    Failing.commits = None
    retry(spool)
    spool.close()
    with running(path) as again:
        assert kept(again) == list(range(3, 13))


def test_a_disk_that_fails_at_the_start_is_taken_into_use_when_it_works(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 3, boot=RUNS[0])
    missing = path.parent / "away"
    spool = spool_at(missing / "spool.db")
    assert "kept in memory only" in (spool.alarm or "")
    fill(spool, 4)
    assert kept(spool) == [0, 1, 2, 3], "published from memory"
    spool.ack(1)
    missing.mkdir()
    for file in path.parent.glob("spool.db*"):
        shutil.copy(file, missing)
    retry(spool)
    assert spool.alarm is None
    assert spool.previous("vesc") == ((RUNS[0], 2),), "from now on"
    fill(spool, 1, first=4)
    assert kept(spool) == [1, 2, 3, 0, 1, 2, 4], "what was on the disk is sent too"
    for entry in all_kept(spool):
        spool.ack(entry.id)
    assert spool.previous("vesc") is None
    spool.close()
    with running(missing / "spool.db") as again:
        assert again.backlog().batches == 0
        assert again.previous("vesc") == ((BOOT, 4),)


def test_a_batch_that_arrives_while_it_is_being_written_is_not_kept(path: Path) -> None:
    class Slow(Failing):
        def commit(self, *arguments: Any, **more: Any) -> None:
            super().commit(*arguments, **more)
            for entry_id in meanwhile:
                spool.ack(entry_id)

    meanwhile: list[int] = []
    spool = spool_at(path, open_file=Slow)
    Failing.commits = sqlite3.OperationalError("any text")
    fill(spool, 3)
    spool.work()
    meanwhile = [entry.id for entry in all_kept(spool)[:2]]
    Failing.commits = None
    retry(spool)
    assert kept(spool) == [2]
    spool.close()
    with running(path) as again:
        assert kept(again) == [2]


def test_a_file_that_cannot_be_read_for_a_while_comes_behind(path: Path) -> None:
    """As where a disk is pulled out and put back."""

    class Away(Failing):
        def check_writable(self) -> None:
            raise sqlite3.OperationalError("any text")

    with running(path) as spool:
        fill(spool, 3)
    spool = spool_at(path, open_file=Away)
    Failing.reads = Failing.commits = sqlite3.OperationalError("any text")
    assert following(spool, 0) is None
    assert spool.alarm is not None
    fill(spool, 2, first=10)
    assert kept(spool) == [10, 11]
    Failing.reads = Failing.commits = None
    retry(spool)
    assert kept(spool) == [10, 11, 0, 1, 2]
    assert spool.alarm is None
    assert spool.dropped() == (0, 0)
    spool.close()


def test_a_part_that_cannot_be_read_is_damage_if_the_disk_works(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 3)
    with running(path, open_file=Failing) as spool:
        Failing.reads = sqlite3.OperationalError("any text")
        spool.next(0)
        spool.work()
        Failing.reads = None
        assert "damaged" in (spool.alarm or "")
        assert kept(spool) == [0, 1, 2]
    assert len(aside(path)) == 1


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


@pytest.mark.parametrize("stopped", [True, False])
def test_pages_flipped_in_the_middle_cost_only_what_was_in_them(path: Path, stopped: bool) -> None:
    spool = spool_at(path, max_bytes=10 * MB)
    fill(spool, 1, stream="rtt")
    spool.ack(following(spool, 0).id)
    for seq in range(2000):
        spool.put("vesc", BOOT, seq, b"%01000d" % seq, samples=1)
    spool.work()
    if stopped:
        spool.close()
    else:
        assert spool._file is not None
        spool._file.connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        spool._file.connection.execute("PRAGMA cache_size = 0")
    flip_pages(path, range(500, 510))
    if stopped:
        spool = spool_at(path, max_bytes=10 * MB)
    all_kept(spool)
    # Those before the damage come again, with what was saved.
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
    fill(spool, 1, first=2000)
    spool.close()
    with running(path, max_bytes=10 * MB) as again:
        assert kept(again) == [*seqs, 2000]
        assert again.previous("vesc") == ((BOOT, 2000),)
        assert again.previous("rtt") == ((BOOT, 0),)


def test_batches_that_vanish_from_the_file_are_counted(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 10)
    with running(path) as spool:
        assert spool._file is not None
        spool._file.connection.execute("DELETE FROM batches WHERE seq IN (3, 9)")
        kept(spool)
        assert kept(spool) == [0, 1, 2, 4, 5, 6, 7, 8]
        assert spool.dropped() == (2, 10)
        assert "2 batches are missing" in (spool.alarm or "")


def test_a_full_queue_whose_batches_vanished_takes_new_ones(path: Path) -> None:
    with running(path, max_bytes=100) as spool:
        fill(spool, 10)
        spool.work()
        assert spool._file is not None
        spool._file.connection.execute("DELETE FROM batches WHERE seq > 0")
        fill(spool, 3, first=10)
        spool.work()
        assert "batches are missing" in (spool.alarm or "")
        spool.work()
        assert kept(spool) == [10, 11, 12]
        assert spool.dropped() == (10, 50)


@pytest.mark.parametrize("at", ["copying", "renaming"])
def test_a_kill_while_a_new_file_is_made_loses_nothing(path: Path, at: str) -> None:
    class Killed(SpoolFile):
        def commit(self, *arguments: Any, **more: Any) -> None:
            if at == "copying":
                raise SystemExit
            super().commit(*arguments, **more)

        def close(self) -> None:
            super().close()
            if at == "renaming":
                # The damaged file is away already, and the new one is not in its place.
                path.unlink()
                raise SystemExit

    with running(path) as spool:
        for i in range(10):
            spool.put("vesc", BOOT, i, b"payload %d" % i * 10, samples=3)
    path.write_bytes(path.read_bytes().replace(b"payload 4payload 4", b"payload 4payload 5", 1))
    spool = spool_at(path, open_file=Killed)
    spool.next(0)
    with pytest.raises(SystemExit):
        spool.work()
    crash(spool, path.parent)
    with running(path) as again:
        assert kept(again) == [0, 1, 2, 3, 5, 6, 7, 8, 9]


@pytest.mark.parametrize("renames", range(4))
def test_a_kill_between_two_renames_loses_nothing(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renames: int
) -> None:
    spool = spool_at(path)
    fill(spool, 10)
    spool.work()
    assert spool._file is not None
    spool._file.connection.execute("UPDATE batches SET crc = 0 WHERE seq = 4")
    left, replace = iter(range(renames)), Path.replace

    def killed(self: Path, target: Any) -> Path:
        if next(left, None) is None:
            raise SystemExit
        return replace(self, target)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", killed)
        with pytest.raises(SystemExit):
            spool._replace(sqlite3.DatabaseError("batch 5 is not as it was written"))
    with running(crash(spool, tmp_path)) as again:
        retry(again)
        assert sorted({*kept(again)}) == [0, 1, 2, 3, 5, 6, 7, 8, 9]


def test_a_damaged_file_on_a_full_disk_waits_for_room(path: Path) -> None:
    with running(path) as spool:
        for i in range(10):
            spool.put("vesc", BOOT, i, b"payload %d" % i * 10, samples=3)
    path.write_bytes(path.read_bytes().replace(b"payload 4payload 4", b"payload 4payload 5", 1))
    spool = spool_at(path, open_file=Failing)
    Failing.commits = sqlite3.OperationalError("any text")
    spool.next(0)
    spool.work()
    fill(spool, 2, first=10)
    retry(spool)
    assert spool.alarm is not None
    assert spool.dropped() == (0, 0)
    Failing.commits = None
    retry(spool)
    retry(spool)
    kept(spool)
    assert sorted(kept(spool)) == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11]
    assert spool.dropped() == (1, 3)
    spool.close()


def test_the_log_of_a_removed_file_is_not_written_into_the_new_one(path: Path) -> None:
    spool = spool_at(path, max_bytes=8 * MB)
    arrived = set()
    for first in range(0, 1600, 20):
        fill(spool, 20, size=1500, first=first)
        spool.work()
        # SQLite has begun its log anew meanwhile, so the log has a part of the pages only.
        for entry in all_kept(spool)[:15]:
            spool.ack(entry.id)
            arrived.add(entry.seq)
    path.unlink()
    fill(spool, 1, first=1600)
    for _ in range(3):
        spool.work()
    assert spool.dropped() == (0, 0)
    assert spool.damaged == 1
    assert sorted(kept(spool)) == sorted(set(range(1601)) - arrived)
    spool.close()


def test_a_file_removed_between_two_runs_is_told(path: Path) -> None:
    with running(path) as spool:
        fill(spool, 10)
    path.unlink()
    with running(path) as spool:
        assert "removed" in (spool.alarm or "")
        assert spool.damaged == 1
    with running(path) as spool:
        assert (spool.alarm, spool.damaged) == (None, 0)


def test_only_the_newest_damaged_files_are_kept(path: Path) -> None:
    clock = ManualClock()
    for _ in range(6):
        with running(path, clock=clock) as spool:
            fill(spool, 1)
        path.write_bytes(b"x" * 10_000)
        clock.advance(1)
    assert len(aside(path)) == 3


# --- another's file -----------------------------------------------------------------------------------


NOT_OURS, OTHER = "give queue.path another name", "another version of iort-agent"


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("text", NOT_OURS),
        ("database", NOT_OURS),
        (1, OTHER),
        (3, OTHER),
    ],
)
def test_a_file_of_another_program_or_version_is_refused_and_left_alone(
    path: Path, kind: Any, told: str
) -> None:
    if kind == "text":
        path.write_text("notes\n" * 100)
    else:
        if kind != "database":
            with running(path) as spool:
                fill(spool, 3)
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.execute("CREATE TABLE mine (x)" if kind == "database" else f"PRAGMA user_version = {kind}")
    before = path.read_bytes()
    for _ in range(2):
        with pytest.raises(AgentError, match=rf"spool\.db: .*{told}"):
            spool_at(path)
    assert path.read_bytes() == before
    assert not aside(path)


def test_a_second_agent_is_refused_and_told_what_to_do(path: Path) -> None:
    with running(path):
        code = (
            "import sys; from pathlib import Path; from iort_agent.common.threads import SystemClock\n"
            "from iort_agent.spool.sqlite import SqliteSpool\n"
            "SqliteSpool(Path(sys.argv[1]), max_bytes=1000, clock=SystemClock())"
        )
        second = subprocess.run(
            [sys.executable, "-c", code, str(path)], cwd=ROOT, capture_output=True, text=True, check=False
        )
    assert second.returncode == 1
    assert (
        f"spool.db.lock: the queue is in use by another iort-agent (process {os.getpid()})" in second.stderr
    )
    assert "end that one, or give this robot a queue.path of its own" in second.stderr
    spool_at(path).close()
