"""The spool on disk: restarts, crashes, full and damaged disks; numbers never used twice."""

from __future__ import annotations

import contextlib
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from device import sqlite_spool
from device.clock import ManualClock, SystemClock
from device.config import QueueConfig
from device.errors import AgentError
from device.ledger import Ledger
from device.reservation import BLOCK, BLOCK_ADRIFT, Reservation
from device.spool import FULL, PROCESS, REJECT_NEW, Entry, MemorySpool
from device.spool_file import SpoolFile
from device.sqlite_spool import SqliteSpool, make_spool
from tests.unit.test_device_spool import fill, following, kept

ROOT = Path(__file__).parent.parent.parent
MB = 1024 * 1024


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.db"


def spool_at(path: Path, **changes: Any) -> SqliteSpool:
    return SqliteSpool(path, **{"max_bytes": MB, "clock": ManualClock(), **changes})


@contextlib.contextmanager
def running(path: Path, **changes: Any) -> Iterator[SqliteSpool]:
    spool = spool_at(path, **changes)
    yield spool
    spool.close()


def crash(spool: SqliteSpool, to: Path) -> Path:
    """What a kill at this moment leaves on the disk, in a folder of its own; the spool itself ends."""
    folder = Path(tempfile.mkdtemp(dir=to))
    for file in spool._path.parent.glob("spool.db*"):
        if file.is_file() and not file.name.endswith("-shm"):
            shutil.copy(file, folder)
    spool._close_files()
    spool._closed = True
    return folder / "spool.db"


def all_kept(spool: SqliteSpool) -> list[Entry]:
    out: list[Entry] = []
    while (entry := following(spool, out[-1].id if out else 0)) is not None:
        out.append(entry)
    return out


# --- restarts ----------------------------------------------------------------------------------------


def test_goes_on_where_the_run_before_ended(path: Path) -> None:
    with running(path, policy=REJECT_NEW, max_bytes=100) as spool:
        fill(spool, 12)
        fill(spool, 1, stream="rtt", size=200)
        spool.ack(following(spool, 0).id)
    with running(path) as spool:
        assert kept(spool) == [1, 2, 3, 4, 5, 6, 7, 8, 9]
        assert (spool.next_seq("vesc"), spool.next_seq("rtt"), spool.next_seq("new")) == (12, 1, 0)
        assert spool.backlog() == (9, 45, 90)
        assert spool.dropped() == (0, 0)
        assert spool.dropped_ever() == (3, 15), "drops are remembered"
        assert spool.durable


def test_nothing_is_handed_out_before_it_is_on_the_disk(path: Path, tmp_path: Path) -> None:
    """What a power cut or a kill at the moment of the publish leaves has the batch and its number."""
    spool = spool_at(path)
    fill(spool, 1)
    assert spool.next(0) is None
    told: list[tuple[Any, list[Any], list[Any]]] = []

    def look() -> None:
        with contextlib.closing(sqlite3.connect(path)) as db:
            batches = db.execute("SELECT seq FROM batches").fetchall()
            told.append((spool.next(0), batches, db.execute("SELECT * FROM streams").fetchall()))

    spool.on_stored(look)
    spool.flush()
    ((entry, batches, streams),) = told
    assert entry is not None
    assert (batches, streams) == ([(0,)], [("vesc", 1)])
    again = spool_at(crash(spool, tmp_path))
    assert kept(again) == [0]
    again.close()


@pytest.mark.parametrize(("durability", "synchronous"), [(PROCESS, 1), (FULL, 2)])
def test_durability_is_sqlites(path: Path, durability: str, synchronous: int) -> None:
    """2, FULL: the log is synced before COMMIT returns, which is before `next` gives the batch."""
    with running(path, durability=durability) as spool:
        assert spool._file is not None
        assert spool._file._number("synchronous") == synchronous
        assert spool._file._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


@pytest.mark.parametrize("durability", [PROCESS, FULL])
def test_after_a_power_cut_numbers_that_may_have_been_used_are_not(
    path: Path, tmp_path: Path, durability: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_spool, "_machine", lambda: "first")
    spool = spool_at(path, durability=durability)
    fill(spool, 5)
    spool.flush()
    # With PROCESS, the kernel may not have written what the database says it has: go back in time.
    survived = crash(spool, tmp_path)
    monkeypatch.setattr(sqlite_spool, "_machine", lambda: "second")
    if durability == PROCESS:
        for file in survived.parent.glob("spool.db-wal"):
            file.write_bytes(b"")
    with running(survived, durability=durability) as spool:
        assert spool.next_seq("vesc") == (5 if durability == FULL else 5 + BLOCK)
        assert spool.alarm is None
        fill(spool, 1)
    monkeypatch.setattr(sqlite_spool, "_machine", lambda: "third")
    with running(survived, durability=durability) as spool:
        assert spool.next_seq("vesc") == (6 if durability == FULL else 6 + BLOCK), "it was closed"


def test_acknowledgements_and_puts_are_written_in_groups(path: Path) -> None:
    spool = spool_at(path, clock=SystemClock())
    commits: list[int] = []
    assert spool._file is not None
    write = spool._file.commit

    def count(entries: Any, **more: Any) -> None:
        commits.append(len(entries))
        write(entries, **more)

    spool._file.commit = count  # type: ignore[method-assign]
    stored = threading.Event()
    spool.on_stored(stored.set)
    spool.start()
    fill(spool, 100)
    assert stored.wait(10)
    assert sum(commits) == 100
    assert len(commits) < 10
    spool.close()


def test_the_file_is_given_back_and_reads_ahead_of_the_window(path: Path) -> None:
    with running(path, max_bytes=50 * MB, memory_bytes=50 * MB) as spool:
        for seq in range(300):
            spool.put("vesc", seq, b"%-100000d" % seq, samples=1)
        spool.flush()
        size = path.stat().st_size
        after, read = 0, []
        while (entry := following(spool, after)) is not None:
            read.append((entry.seq, int(entry.payload[:20])))
            after = entry.id
            assert spool._window.payload_bytes < 5 * MB, "memory is bounded"
        assert read == [(seq, seq) for seq in range(300)]
        assert following(spool, 0).seq == 0, "from the beginning, after a failure"
        for entry_id in range(1, 301):
            spool.ack(entry_id)
        for _ in range(20):
            spool.flush()
    assert size > 20 * MB
    assert path.stat().st_size < 8 * MB
    assert not path.with_name("spool.db-wal").exists()


# --- any order of events ----------------------------------------------------------------------------


class Life(RuleBasedStateMachine):
    """Puts, publishes, acknowledgements, restarts, crashes and disk trouble, beside a simple model."""

    def __init__(self) -> None:
        super().__init__()
        # In memory where that is possible: it is syncs that take the time, and here they prove nothing.
        self.folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        self.runs = 0
        self.content: dict[tuple[str, int], bytes] = {}
        self.live: list[tuple[str, int, bytes]] = []
        self.durable: list[tuple[str, int, bytes]] = []
        self.seqs: dict[str, int] = {}
        self.at_least: dict[str, int] = {}
        self.jump = False
        self.begin(self.folder / "spool.db")

    def begin(self, path: Path) -> None:
        self.runs += 1
        self.spool = spool_at(path, max_bytes=400)

    @rule(stream=st.sampled_from(["a", "b"]), size=st.integers(0, 150))
    def put(self, stream: str, size: int) -> None:
        seq = self.spool.next_seq(stream)
        if self.jump:
            assert seq >= self.at_least.get(stream, 0)
        else:
            assert seq == self.seqs.get(stream, 0)
        payload = (b"%d:%d:" % (self.runs, seq)).ljust(size, b".")
        self.spool.put(stream, seq, payload, samples=1)
        self.seqs[stream] = seq + 1
        self.live.append((stream, seq, payload))
        while sum(len(p) for _, _, p in self.live) > 400:
            del self.live[0]

    @rule()
    def flush(self) -> None:
        assert self.spool.flush()
        self.durable = list(self.live)
        self.durable_seqs = dict(self.seqs)

    @rule(count=st.integers(0, 8), ack=st.booleans())
    def publish(self, count: int, ack: bool) -> None:
        after = 0
        for _ in range(count):
            entry = self.spool.next(after)
            if entry is None:
                return
            after = entry.id
            batch = (entry.stream, entry.seq, entry.payload)
            assert batch in self.live
            assert batch in self.durable, "never before it is durable"
            assert self.content.setdefault(batch[:2], entry.payload) == entry.payload
            self.at_least[entry.stream] = max(self.at_least.get(entry.stream, 0), entry.seq + 1)
            if ack:
                self.spool.ack(entry.id)
                self.live.remove(batch)

    @rule()
    def restart(self) -> None:
        self.flush()
        self.spool.close()
        self.begin(self.spool._path)

    @rule()
    def kill(self) -> None:
        self.begin(crash(self.spool, self.folder))
        self.live = list(self.durable)
        self.seqs = dict(getattr(self, "durable_seqs", {}))

    @precondition(lambda self: self.runs < 20)
    @rule()
    def lose_the_database(self) -> None:
        self.spool.close()
        self.spool._path.write_bytes(b"garbage" * 1000)
        self.begin(self.spool._path)
        assert "damaged" in (self.spool.alarm or "")
        self.live, self.durable, self.jump = [], [], True
        for stream, at_least in self.at_least.items():
            assert self.spool.next_seq(stream) >= at_least
        self.seqs = {s: self.spool.next_seq(s) for s in ("a", "b")}
        self.durable_seqs = dict(self.seqs)

    @invariant()
    def keeps_what_the_model_keeps(self) -> None:
        backlog = self.spool.backlog()
        assert backlog.batches == len(self.live)
        assert backlog.payload_bytes == sum(len(p) for _, _, p in self.live)

    def teardown(self) -> None:
        self.flush()
        got = [(e.stream, e.seq, e.payload) for e in all_kept(self.spool)]
        assert got == self.live, "in order"
        self.spool.close()
        shutil.rmtree(self.folder)


TestLife = Life.TestCase
TestLife.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)


# --- kill -9 ------------------------------------------------------------------------------------------

VICTIM = """
import os, sys, threading
from pathlib import Path
from device.clock import SystemClock
from device.sqlite_spool import SqliteSpool

path, run = Path(sys.argv[1]), sys.argv[2]
spool = SqliteSpool(path, max_bytes=2**30, clock=SystemClock())
wake = threading.Event()
spool.on_stored(wake.set)
spool.start()

def puts():
    while run != "last":
        for stream in ("a", "b"):
            seq = spool.next_seq(stream)
            spool.put(stream, seq, f"{run} {stream} {seq} ".encode() * 20, samples=1)
        threading.Event().wait(0.0005)

threading.Thread(target=puts, daemon=True).start()
last = count = 0
while True:
    wake.clear()
    entry = spool.next(last)
    if entry is None:
        if run == "last" and not spool.backlog().batches:
            break
        wake.wait(1)
        continue
    last = entry.id
    count += 1
    os.write(1, f"{entry.stream} {entry.seq} {entry.payload[:40].decode()}\\n".encode())
    spool.ack(entry.id)
    if run != "last" and count % 300 == 0:
        last = 0
spool.close()
os.write(1, b"end\\n")
"""


def test_kill_9_at_random_moments_loses_no_published_batch_and_uses_no_number_twice(path: Path) -> None:
    chance = random.Random(7)
    content: dict[tuple[str, int], str] = {}
    order: dict[str, list[int]] = {"a": [], "b": []}
    for run in [*map(str, range(15)), "last"]:
        victim = subprocess.Popen(
            [sys.executable, "-c", VICTIM, str(path), run], cwd=ROOT, stdout=subprocess.PIPE, text=True
        )
        lines = chance.randrange(1, 800)
        assert victim.stdout is not None
        complete = False
        for i, line in enumerate(victim.stdout):
            if line == "end\n":
                complete = True
                break
            if not line.endswith("\n"):
                break
            stream, seq, payload = line.rstrip().split(" ", 2)
            key = (stream, int(seq))
            assert content.setdefault(key, payload) == payload, "a number used twice"
            if int(seq) not in order[stream][-2000:]:
                order[stream].append(int(seq))
            if run != "last" and i == lines:
                victim.kill()
        victim.stdout.close()
        victim.kill()
        victim.wait()
        assert complete == (run == "last")
    for stream, seqs in order.items():
        assert seqs == list(range(len(seqs))), f"{stream}: each one, in order, without a hole"
        assert len(seqs) > 500
    runs = {payload.split()[0] for payload in content.values()}
    assert len(runs) > 10


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
    assert 90_000 < sum(map(len, (e.payload for e in spool._pending.values()))) <= 100_000
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
from device.clock import SystemClock
from device.sqlite_spool import SqliteSpool

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
        assert spool._file is not None
        spool._file._db.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        spool._file._db.execute("PRAGMA cache_size = 0")
        spool._window.clear()
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
    spool._close_files()
    assert path.exists(), "the new file is there, and empty"
    with running(path) as again:
        assert again.next_seq("vesc") >= 10
        assert again.alarm is None


def test_what_was_acknowledged_while_the_disk_was_full_does_not_come_again(path: Path) -> None:
    spool = spool_at(path)
    fill(spool, 5)
    spool.flush()
    assert spool._file is not None
    commit = spool._file.commit

    def full(*_: Any, **__: Any) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    spool._file.commit = full  # type: ignore[method-assign]
    for entry in all_kept(spool)[:3]:
        spool.ack(entry.id)
    assert not spool.flush()
    spool._file.commit = commit  # type: ignore[method-assign]
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
            "import sys; from pathlib import Path; from device.clock import SystemClock\n"
            "from device.sqlite_spool import SqliteSpool\n"
            "SqliteSpool(Path(sys.argv[1]), max_bytes=1000, clock=SystemClock())"
        )
        second = subprocess.run(
            [sys.executable, "-c", code, str(path)], cwd=ROOT, capture_output=True, text=True, check=False
        )
    assert second.returncode == 1
    assert "spool.db.seq: the queue is in use by another iort-agent (process " in second.stderr
    assert "end that one, or give this robot a queue.path of its own" in second.stderr
    spool_at(path).close()


def test_the_ledger_forgets_in_any_order() -> None:
    chance, ledger = random.Random(3), Ledger()
    model: dict[int, int] = {}
    for entry_id in range(1, 20_001):
        ledger.add(entry_id, entry_id % 100, 1)
        model[entry_id] = entry_id % 100
        while len(model) > 50:
            gone = chance.choice(list(model)[:20])
            assert ledger.remove(gone) == (model.pop(gone), 1)
            assert ledger.remove(gone) is None
        after = chance.randrange(entry_id)
        assert ledger.next(after) == next((i for i in model if i > after), None)
    assert list(ledger) == list(model)
    assert (ledger.batches, ledger.payload_bytes) == (50, sum(model.values()))
    assert len(ledger._ids) < 3000, "memory is given back"


# --- parts --------------------------------------------------------------------------------------------


def test_a_reservation_cut_short_leaves_the_one_before(path: Path) -> None:
    numbers = Reservation(path)
    numbers.write(reserve={"vesc": 10})
    numbers.write(reserve={"vesc": 20})
    newest = numbers.state["turn"] % 2
    numbers.close()
    with path.open("r+b") as file:
        file.seek(newest * 16 * 1024 + 100)
        file.write(b"cut")
        file.seek(newest * 16 * 1024 + 12)
        file.write(b"cut")
    numbers = Reservation(path)
    assert numbers.reserved("vesc") == 10
    numbers.write(reserve={f"stream{i:060}": i for i in range(1000)})
    assert numbers.reserved("any") == 999, "too many to name share one"
    numbers.close()


def test_a_commit_that_fails_leaves_nothing_half_done(path: Path) -> None:
    file = SpoolFile(path, durability=PROCESS)
    good = Entry(1, "vesc", 0, b"x", 1)
    not_a_number: Any = object()
    bad = Entry(2, "vesc", not_a_number, b"x", 1)
    with pytest.raises(sqlite3.Error):
        file.commit([good, bad])
    assert file.load().batches == []
    file.commit([good])
    file.commit([good])
    assert file.read(0, 100) == [good]
    file.close()


def test_the_configuration_makes_the_spool(path: Path) -> None:
    class Settings:
        queue = QueueConfig(path=path, durability=FULL)

    config: Any = Settings()
    spool = make_spool(config, SystemClock())
    assert isinstance(spool, SqliteSpool)
    spool.put("vesc", 0, b"x", samples=1)
    spool.close()
    config.queue = QueueConfig()
    assert isinstance(make_spool(config, SystemClock()), MemorySpool)
