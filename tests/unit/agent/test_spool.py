"""The spool: order, bound and policies, then any order of events and faults."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from iort_agent.common.threads import SystemClock
from iort_agent.spool import FULL, OVERWRITE_OLDEST, PROCESS, REJECT_NEW, Entry, QueueConfig
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.sqlite import RETRY_S, SqliteSpool, make_spool
from testkit.agent import ManualClock
from testkit.waiting import GUARD_S
from tests.examples import examples

ROOT = Path(__file__).parents[3]
MB = 1024 * 1024
BOOT = "0badcafe0badcafe"
RUNS = [f"{n:08x}" for n in range(1, 40)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.db"


class Failing(SpoolFile):
    """A file whose commits fail, and whose reads too, while these say how."""

    commits: Exception | None = None
    reads: Exception | None = None

    def commit(self, *arguments: Any, **more: Any) -> None:
        if Failing.commits is not None:
            raise Failing.commits
        super().commit(*arguments, **more)

    def read(self, after: int, to: int) -> Any:
        if Failing.reads is not None:
            raise Failing.reads
        return super().read(after, to)


@pytest.fixture(autouse=True)
def works() -> None:
    Failing.commits = Failing.reads = None


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
    if spool._file is not None:
        spool._file.abandon()
    spool._unlock()
    spool._closed = True
    return folder / "spool.db"


def fill(
    spool: SqliteSpool, count: int, size: int = 10, *, stream: str = "vesc", first: int = 0, boot: str = BOOT
) -> None:
    for seq in range(first, first + count):
        spool.put(stream, boot, seq, b"x" * size, samples=5)


def retry(spool: SqliteSpool) -> None:
    """The next time that the spool's thread looks at the disk."""
    spool._clock.wait(spool._kick, 0)
    clock: Any = spool._clock
    clock.advance(RETRY_S)
    spool.work()


def following(spool: SqliteSpool, after: int) -> Any:
    """The next batch, once it is to hand."""
    for _ in range(2):
        entry = spool.next(after)
        if entry is not None:
            return entry
        spool.work()
    return spool.next(after)


def all_kept(spool: SqliteSpool) -> list[Entry]:
    out: list[Entry] = []
    while (entry := following(spool, out[-1].id if out else 0)) is not None:
        out.append(entry)
    return out


def kept(spool: SqliteSpool) -> list[int]:
    return [entry.seq for entry in all_kept(spool)]


# --- order and bound -----------------------------------------------------------------------------------


def test_keeps_in_order_until_acknowledged_and_says_when_there_is_a_batch(path: Path) -> None:
    spool = spool_at(path, max_bytes=1000)
    offered: list[Any] = []
    spool.on_stored(lambda: offered.append(spool.next(0)))
    fill(spool, 3)
    assert offered == [], "not before it is durable"
    spool.work()
    first = following(spool, 0)
    assert first == offered[0] == (1, "vesc", 0, b"x" * 10, 5)
    fill(spool, 1, stream="rtt")
    assert spool.previous("vesc") == spool.previous("rtt") == ()
    spool.ack(first.id)
    spool.ack(first.id)
    assert spool.previous("vesc") is None, "a batch of this run has arrived"
    assert spool.previous("rtt") == ()
    assert kept(spool) == [1, 2, 0]
    assert spool.backlog() == (3, 15, 30)
    assert spool.alarm is None
    spool.close()


@pytest.mark.parametrize(("policy", "left"), [(OVERWRITE_OLDEST, [7, 8, 9]), (REJECT_NEW, [0, 1, 2])])
@pytest.mark.parametrize("at_once", [True, False])
def test_drops_as_the_policy_says(path: Path, policy: str, left: list[int], at_once: bool) -> None:
    spool = spool_at(path, max_bytes=35, policy=policy)
    for seq in range(10):
        fill(spool, 1, first=seq)
        if not at_once:
            spool.work()
    fill(spool, 1, size=36, first=10)
    assert kept(spool) == left, "a batch larger than the spool does not empty it"
    assert spool.dropped() == (8, 40)
    assert spool.backlog() == (3, 15, 30)
    for _ in range(10):
        while (entry := following(spool, 0)) is not None:
            spool.ack(entry.id)
        fill(spool, 3, first=11)
    assert spool.dropped() == (8, 40), "acknowledgements make room"
    spool.close()


# --- any order of events -------------------------------------------------------------------------------


class Life(RuleBasedStateMachine):
    """Puts, publishes, acknowledgements, restarts, kills, and every fault of disk and file, beside a simple
    model: ``live`` is what the spool has, ``durable`` what is in the file."""

    def __init__(self) -> None:
        super().__init__()
        # In memory where that is possible: it is syncs that take the time, and here they prove nothing.
        self.folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        Failing.commits = None
        self.runs = 0
        self.live: list[tuple[str, int, bytes]] = []
        self.durable: list[tuple[str, int, bytes]] = []
        # By stream: the last number of each run, as durable, and the runs of which a batch has arrived.
        self.ends: dict[str, dict[str, int]] = {"a": {}, "b": {}}
        self.begin(self.folder / "spool.db")

    def begin(self, path: Path) -> None:
        self.runs += 1
        self.boot = f"{self.runs:08x}"
        self.seqs = {"a": 0, "b": 0}
        Failing.commits = None
        self.spool = spool_at(path, max_bytes=400, open_file=Failing)
        self.before = {stream: tuple(ends.items()) for stream, ends in self.ends.items()}
        self.arrived: set[str] = set()
        # The batches that were put since the spool took its file over: those say which runs were before.
        self.naming: list[tuple[str, int, bytes]] = []

    @rule(stream=st.sampled_from(["a", "b"]), size=st.integers(0, 150))
    def put(self, stream: str, size: int) -> None:
        expected = None if stream in self.arrived else self.before[stream][-16:]
        assert self.spool.previous(stream) == expected
        seq = self.seqs[stream]
        payload = (b"%d:%d:" % (self.runs, seq)).ljust(size, b".")
        self.spool.put(stream, self.boot, seq, payload, samples=1)
        self.seqs[stream] = seq + 1
        self.live.append((stream, seq, payload))
        self.naming.append((stream, seq, payload))
        # What waits in memory is bounded at once, what is in the file with the next transaction.
        waiting = [batch for batch in self.live if batch not in self.durable]
        while sum(len(p) for _, _, p in waiting) > 400:
            self.live.remove(waiting.pop(0))

    @rule()
    def write(self) -> None:
        while sum(len(p) for _, _, p in self.live) > 400:
            del self.live[0]
        retry(self.spool)
        failing = Failing.commits is not None and bool(self.spool._gone or len(self.spool._memory))
        if Failing.commits is not None:
            assert self.spool.durable or "does not work" in (self.spool.alarm or "")
            assert not (failing and self.spool.durable)
            return
        self.note_written()
        assert self.spool.durable

    def note_written(self) -> None:
        self.durable = list(self.live)
        for stream, seq in self.seqs.items():
            if seq:
                self.ends[stream][self.boot] = seq - 1
            if stream in self.arrived:
                self.ends[stream] = {r: n for r, n in self.ends[stream].items() if r == self.boot}

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
            if self.spool.durable:
                assert batch in self.durable, "never before it is durable"
            if ack:
                self.spool.ack(entry.id)
                self.live.remove(batch)
                if batch in self.naming:
                    self.arrived.add(entry.stream)

    @rule(text=st.sampled_from(["database or disk is full", "disk I/O error"]))
    def break_the_disk(self, text: str) -> None:
        Failing.commits = sqlite3.OperationalError(text)

    @rule()
    def mend_the_disk(self) -> None:
        Failing.commits = None
        self.write()
        assert "does not work" not in (self.spool.alarm or "")

    @rule()
    def restart(self) -> None:
        self.mend_the_disk()
        self.spool.close()
        self.begin(self.spool._path)
        assert (self.spool.alarm, self.spool.damaged) == (None, 0)
        assert self.spool.dropped() == (0, 0)

    @rule()
    def kill(self) -> None:
        self.begin(crash(self.spool, self.folder))
        # Acknowledgements that were not written yet are lost, and these batches are sent again.
        self.live = list(self.durable)

    @precondition(lambda self: self.runs < 20)
    @rule()
    def lose_the_database(self) -> None:
        self.spool.close()
        self.spool._path.write_bytes(b"garbage" * 1000)
        self.ends = {"a": {}, "b": {}}
        self.begin(self.spool._path)
        assert "damaged" in (self.spool.alarm or "")
        assert (self.spool.dropped(), self.spool.damaged) == ((0, 0), 1)
        self.live, self.durable = [], []
        self.restart()

    @rule(which=st.integers(0, 1000))
    def alter_a_payload(self, which: int) -> None:
        self.restart()
        if not self.live:
            return
        lost = which % len(self.live)
        self.spool.close()
        with contextlib.closing(sqlite3.connect(self.spool._path)) as db:
            (row,) = db.execute("SELECT id FROM batches ORDER BY id LIMIT 1 OFFSET ?", (lost,)).fetchall()
            db.execute("UPDATE batches SET payload = CAST('altered' AS BLOB) WHERE id = ?", row)
            db.commit()
        self.begin(self.spool._path)
        all_kept(self.spool)
        del self.live[lost]
        assert "is not as it was written" in (self.spool.alarm or "")
        assert self.spool.dropped() == (1, 1)
        self.restart()

    # With room for one more: which ones a full queue drops then depends on what it takes over first.
    @precondition(lambda self: sum(len(p) for _, _, p in self.live) <= 380)
    @rule()
    def remove_the_file(self) -> None:
        self.mend_the_disk()
        for suffix in ("", "-wal", "-shm"):
            Path(f"{self.spool._path}{suffix}").unlink()
        before = self.spool.dropped()
        self.put("a", 10)
        self.write()
        self.write()
        assert "removed" in (self.spool.alarm or "")
        assert self.spool.dropped().batches - before.batches <= 1, "for the new one at most"
        # What is in a file that is taken over comes behind what waits.
        self.live = [self.live[-1], *self.live[:-1]]
        self.durable = list(self.live)
        self.naming = []

    @invariant()
    def keeps_what_the_model_keeps(self) -> None:
        backlog = self.spool.backlog()
        assert backlog.batches == len(self.live)
        assert backlog.payload_bytes == sum(len(p) for _, _, p in self.live)

    def teardown(self) -> None:
        self.mend_the_disk()
        assert [(e.stream, e.seq, e.payload) for e in all_kept(self.spool)] == self.live, "in order"
        self.spool.close()
        shutil.rmtree(self.folder)


TestLife = Life.TestCase
TestLife.settings = settings(examples(150), stateful_step_count=40)


# --- restarts ------------------------------------------------------------------------------------------


def test_of_many_runs_the_newest_are_named_first(path: Path) -> None:
    for run in RUNS[:20]:
        with running(path) as spool:
            fill(spool, 1, boot=run)
    for first, last in ((4, 20), (0, 4)):
        with running(path) as spool:
            assert spool.previous("vesc") == tuple((run, 0) for run in RUNS[first:last])
            assert spool.previous("new") == ()
            spool.put("vesc", RUNS[-1], 0, b"x", samples=1)
            for entry in all_kept(spool):
                spool.ack(entry.id)
            spool.work()
            assert spool._file is not None
            # The run itself is named by the next one.
            spool._file.commit([], told=[("vesc", RUNS[-1])])


@pytest.mark.parametrize(("durability", "synchronous"), [(PROCESS, 1), (FULL, 2)])
def test_durability_is_sqlites(path: Path, durability: str, synchronous: int) -> None:
    """2, FULL: the log is synced before COMMIT returns, which is before `next` gives the batch."""
    spool = make_spool(QueueConfig(path=path, durability=durability), SystemClock())
    assert spool._file is not None
    assert spool._file.connection.execute("PRAGMA synchronous").fetchone() == (synchronous,)
    assert spool._file.connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    spool.close()


def test_after_a_power_cut_the_queue_may_be_older_and_says_no_more_than_it_knows(
    path: Path, tmp_path: Path
) -> None:
    with running(path) as spool:
        fill(spool, 2)
    spool = spool_at(path)
    fill(spool, 5, boot=RUNS[0])
    spool.work()
    survived = crash(spool, tmp_path)
    # With PROCESS, the kernel may not have written what the database says it has: go back in time.
    for file in survived.parent.glob("spool.db-wal"):
        file.write_bytes(b"")
    with running(survived) as spool:
        assert kept(spool) == [0, 1]
        assert spool.previous("vesc") == ((BOOT, 1),)
        assert spool.alarm is None


# --- its thread and its file ---------------------------------------------------------------------------


def test_acknowledgements_and_puts_are_written_in_groups(path: Path) -> None:
    commits: list[int] = []

    class Counting(SpoolFile):
        def commit(self, entries: Any, **more: Any) -> None:
            commits.append(len(entries))
            super().commit(entries, **more)

    spool = spool_at(path, clock=SystemClock(), open_file=Counting)
    stored = threading.Event()
    spool.on_stored(stored.set)
    spool.start()
    fill(spool, 100)
    assert stored.wait(GUARD_S)
    spool.close()
    assert sum(commits) == 100
    assert len(commits) < 10


def test_what_happens_while_the_disk_is_busy_counts(path: Path) -> None:
    """Acknowledgements make room while the oldest are dropped, and do not bring back what is being written;
    puts wait for the next pass, so that `next` has its turn."""
    on_their_way: list[Entry] = []
    puts: list[int] = []

    class Slow(SpoolFile):
        def oldest(self, after: int, max_batches: int) -> Any:
            rows = super().oldest(after, max_batches)
            while on_their_way:
                spool.ack(on_their_way.pop().id)
            return rows

        def commit(self, entries: Any, **more: Any) -> None:
            super().commit(entries, **more)
            if puts:
                fill(spool, 1, first=puts.pop(0), size=1000)

    with running(path, max_bytes=100_000, open_file=Slow) as spool:
        fill(spool, 100, size=1000)
        on_their_way += all_kept(spool)[:50]
        fill(spool, 60, size=1000, first=100)
        spool.work()
        assert (spool.dropped().batches, spool.alarm) == (10, None)
        assert kept(spool) == list(range(60, 160))
        for entry in all_kept(spool)[:90]:
            spool.ack(entry.id)
        puts += range(160, 180)
        spool.work()
        assert len(puts) == 19, "one transaction"
        puts.clear()
        assert kept(spool) == list(range(150, 161))


def test_the_file_is_given_back_and_read_piece_by_piece(path: Path) -> None:
    with running(path, max_bytes=50 * MB, memory_bytes=50 * MB) as spool:
        for seq in range(300):
            spool.put("vesc", BOOT, seq, b"%-100000d" % seq, samples=1)
        spool.work()
        size = path.stat().st_size
        read: list[Entry] = []
        while (entry := following(spool, read[-1].id if read else 0)) is not None:
            read.append(entry)
            if len(read) > 20:
                spool.ack(read[-20].id)
            held = sum(len(each.payload) for each in spool._page.values())
            assert held < 5 * MB, "memory is bounded while acknowledgements come"
        assert [(e.seq, int(e.payload[:20])) for e in read] == [(seq, seq) for seq in range(300)]
        assert following(spool, 0).seq == 0, "from the beginning, after a failure"
        for entry in read:
            spool.ack(entry.id)
        for _ in range(20):
            spool.work()
    assert size > 20 * MB
    assert path.stat().st_size < 8 * MB
    assert not path.with_name("spool.db-wal").exists()


def test_a_commit_that_fails_leaves_nothing_half_done(path: Path) -> None:
    file = SpoolFile(path, PROCESS)
    good = Entry(1, "vesc", 0, b"x", 1)
    not_a_number: Any = object()
    bad = Entry(2, "vesc", not_a_number, b"x", 1)
    with pytest.raises(sqlite3.Error):
        file.commit([good, bad])
    assert file.totals() == (0, (0, 0, 0))
    file.commit([good])
    file.commit([good])
    assert file.read(0, 100) == [good]
    file.close()
