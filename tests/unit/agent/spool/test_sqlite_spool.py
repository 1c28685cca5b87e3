"""The spool on disk: what a restart, a kill or a power cut finds, and any order of events."""

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

from iort_agent.common.threads import SystemClock
from iort_agent.spool import FULL, PROCESS, REJECT_NEW, Entry, QueueConfig
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.memory import MemorySpool
from iort_agent.spool.sqlite import SqliteSpool, make_spool
from testkit.agent import ManualClock
from tests.examples import examples
from tests.unit.agent.spool.test_spool import BOOT, fill, following, kept

ROOT = Path(__file__).parents[4]
MB = 1024 * 1024
RUNS = [f"{n:08x}" for n in range(1, 40)]


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
    if spool._file is not None:
        spool._file.abandon()
    spool._unlock()
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
        fill(spool, 12, boot=RUNS[0])
        fill(spool, 1, stream="rtt", size=200, boot=RUNS[0])
        spool.ack(following(spool, 0).id)
    with running(path) as spool:
        assert kept(spool) == [1, 2, 3, 4, 5, 6, 7, 8, 9]
        # With the numbers of dropped batches, so that the loss shows.
        assert spool.previous("vesc") == ((RUNS[0], 11),)
        assert spool.previous("rtt") == ((RUNS[0], 0),)
        assert spool.previous("new") == ()
        assert spool.backlog() == (9, 45, 90)
        assert spool.dropped() == (0, 0)
        assert spool.durable


def test_a_run_is_named_until_a_batch_that_names_it_has_arrived(path: Path, tmp_path: Path) -> None:
    def named(spool: SqliteSpool) -> Any:
        previous = spool.previous("vesc")
        return None if previous is None else [tuple(end) for end in previous]

    with running(path) as spool:
        fill(spool, 3, boot=RUNS[0])
    # Its first batch waits when the next run starts.
    with running(path) as spool:
        assert named(spool) == [(RUNS[0], 2)]
        fill(spool, 2, boot=RUNS[1])
    # It dies before its first batch is written.
    spool = spool_at(path)
    fill(spool, 1, boot=RUNS[2])
    path = crash(spool, tmp_path)
    # A batch of another run arrives, and one of another stream.
    with running(path) as spool:
        fill(spool, 1, boot=RUNS[3], stream="rtt")
        fill(spool, 2, boot=RUNS[3])
        for entry in all_kept(spool)[:6]:
            spool.ack(entry.id)
        assert named(spool) == [(RUNS[0], 2), (RUNS[1], 1)]
        assert spool.previous("rtt") is None
    # Its own first batch is dropped unsent: the next one names the runs too.
    with running(path, max_bytes=100) as spool:
        assert named(spool) == [(RUNS[0], 2), (RUNS[1], 1), (RUNS[3], 1)]
        fill(spool, 1, boot=RUNS[4])
        spool.work()
        fill(spool, 1, boot=RUNS[4], size=100, first=1)
        spool.work()
        assert kept(spool) == [1]
        assert spool.dropped() == (3, 15)
        assert named(spool) is not None
        spool.ack(following(spool, 0).id)
        assert named(spool) is None
        fill(spool, 1, boot=RUNS[4], first=2)
    with running(path) as spool:
        assert named(spool) == [(RUNS[4], 2)]


def test_of_many_runs_the_newest_are_named_first(path: Path) -> None:
    for run in RUNS[:20]:
        with running(path) as spool:
            fill(spool, 1, boot=run)
    for first, last in ((4, 20), (0, 4)):
        with running(path) as spool:
            assert spool.previous("vesc") == tuple((run, 0) for run in RUNS[first:last])
            fill(spool, 1, boot=RUNS[-1], stream="other")
            spool.put("vesc", RUNS[-1], 0, b"x", samples=1)
            for entry in all_kept(spool):
                spool.ack(entry.id)
            spool.work()
            assert spool._file is not None
            # The run itself is named by the next one.
            spool._file.commit([], told=[("vesc", RUNS[-1])])


def test_nothing_is_handed_out_before_it_is_on_the_disk(path: Path, tmp_path: Path) -> None:
    """What a power cut or a kill at the moment of the publish leaves has the batch and its number."""
    spool = spool_at(path)
    fill(spool, 1)
    assert spool.next(0) is None
    told: list[tuple[Any, list[Any], list[Any]]] = []

    def look() -> None:
        with contextlib.closing(sqlite3.connect(path)) as db:
            batches = db.execute("SELECT seq FROM batches").fetchall()
            told.append((spool.next(0), batches, db.execute("SELECT * FROM runs").fetchall()))

    spool.on_stored(look)
    spool.work()
    ((entry, batches, runs),) = told
    assert entry is not None
    assert (batches, runs) == ([(0,)], [("vesc", BOOT, 0)])
    again = spool_at(crash(spool, tmp_path))
    assert kept(again) == [0]
    again.close()


@pytest.mark.parametrize(("durability", "synchronous"), [(PROCESS, 1), (FULL, 2)])
def test_durability_is_sqlites(path: Path, durability: str, synchronous: int) -> None:
    """2, FULL: the log is synced before COMMIT returns, which is before `next` gives the batch."""
    with running(path, durability=durability) as spool:
        assert spool._file is not None
        assert spool._file.connection.execute("PRAGMA synchronous").fetchone() == (synchronous,)
        assert spool._file.connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


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
    assert stored.wait(10)
    spool.close()
    assert sum(commits) == 100
    assert len(commits) < 10


def test_room_that_acknowledgements_make_while_the_oldest_are_dropped_counts(path: Path) -> None:
    on_their_way: list[Entry] = []

    class Acknowledged(SpoolFile):
        def oldest(self, after: int, max_batches: int) -> Any:
            found = super().oldest(after, max_batches)
            while on_their_way:
                spool.ack(on_their_way.pop().id)
            return found

    with running(path, max_bytes=100_000, open_file=Acknowledged) as spool:
        fill(spool, 100, size=1000)
        on_their_way += all_kept(spool)[:50]
        fill(spool, 60, size=1000, first=100)
        spool.work()
        assert (spool.dropped().batches, spool.alarm) == (10, None)
        assert kept(spool) == list(range(60, 160))


def test_a_disk_that_is_slower_than_the_puts_does_not_hold_up_what_is_written(path: Path) -> None:
    puts = iter(range(1, 100))

    class Slow(SpoolFile):
        def commit(self, *arguments: Any, **more: Any) -> None:
            super().commit(*arguments, **more)
            # More comes while the disk is busy, again and again.
            for seq in puts:
                fill(spool, 1, first=seq)
                break

    with running(path, open_file=Slow) as spool:
        fill(spool, 1)
        spool.work()
        assert next(puts) == 2, "one transaction, and then `next` has its turn"
        assert spool.next(0) is not None


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


# --- any order of events ----------------------------------------------------------------------------


class Life(RuleBasedStateMachine):
    """Puts, publishes, acknowledgements, restarts, crashes and disk trouble, beside a simple model."""

    def __init__(self) -> None:
        super().__init__()
        # In memory where that is possible: it is syncs that take the time, and here they prove nothing.
        self.folder = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
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
        self.spool = spool_at(path, max_bytes=400)
        self.before = {stream: tuple(ends.items()) for stream, ends in self.ends.items()}
        self.arrived: set[str] = set()

    @rule(stream=st.sampled_from(["a", "b"]), size=st.integers(0, 150))
    def put(self, stream: str, size: int) -> None:
        expected = None if stream in self.arrived else self.before[stream][-16:]
        assert self.spool.previous(stream) == expected
        seq = self.seqs[stream]
        payload = (b"%d:%d:" % (self.runs, seq)).ljust(size, b".")
        self.spool.put(stream, self.boot, seq, payload, samples=1)
        self.seqs[stream] = seq + 1
        self.live.append((stream, seq, payload))
        # What waits in memory is bounded at once, what is in the file with the next transaction.
        waiting = [batch for batch in self.live if batch not in self.durable]
        while sum(len(p) for _, _, p in waiting) > 400:
            self.live.remove(waiting.pop(0))

    @rule()
    def write(self) -> None:
        while sum(len(p) for _, _, p in self.live) > 400:
            del self.live[0]
        self.spool.work()
        self.durable = list(self.live)
        for stream, seq in self.seqs.items():
            if seq:
                self.ends[stream][self.boot] = seq - 1
            if stream in self.arrived:
                self.ends[stream] = {r: n for r, n in self.ends[stream].items() if r == self.boot}
        assert self.spool.durable

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
            if ack:
                self.spool.ack(entry.id)
                self.live.remove(batch)
                if entry.payload.startswith(b"%d:" % self.runs):
                    self.arrived.add(entry.stream)

    @rule()
    def restart(self) -> None:
        self.write()
        self.spool.close()
        self.begin(self.spool._path)

    @rule()
    def kill(self) -> None:
        acknowledged = [batch for batch in self.durable if batch not in self.live]
        self.begin(crash(self.spool, self.folder))
        # Acknowledgements that were not written yet are lost, and these batches are sent again.
        self.live = list(self.durable)
        assert len(acknowledged) + len(self.live) >= self.spool.backlog().batches

    @precondition(lambda self: self.runs < 20)
    @rule()
    def lose_the_database(self) -> None:
        self.spool.close()
        self.spool._path.write_bytes(b"garbage" * 1000)
        self.ends = {"a": {}, "b": {}}
        self.begin(self.spool._path)
        assert "damaged" in (self.spool.alarm or "")
        self.live, self.durable = [], []
        self.restart()

    @invariant()
    def keeps_what_the_model_keeps(self) -> None:
        backlog = self.spool.backlog()
        assert backlog.batches == len(self.live)
        assert backlog.payload_bytes == sum(len(p) for _, _, p in self.live)

    def teardown(self) -> None:
        self.write()
        got = [(e.stream, e.seq, e.payload) for e in all_kept(self.spool)]
        assert got == self.live, "in order"
        self.spool.close()
        shutil.rmtree(self.folder)


TestLife = Life.TestCase
TestLife.settings = settings(examples(150), stateful_step_count=40)


# --- kill -9 ------------------------------------------------------------------------------------------

VICTIM = """
import os, sys, threading
from pathlib import Path
from iort_agent.common.threads import SystemClock
from iort_agent.spool.sqlite import SqliteSpool

path, run = Path(sys.argv[1]), sys.argv[2]
spool = SqliteSpool(path, max_bytes=2**30, clock=SystemClock())
wake = threading.Event()
spool.on_stored(wake.set)
spool.start()
for stream in ("a", "b"):
    named = " ".join(f"{end.boot}:{end.seq}" for end in spool.previous(stream))
    os.write(1, f"{stream} before {named}\\n".encode())

def puts():
    seq = 0
    while run != "last":
        for stream in ("a", "b"):
            spool.put(stream, run, seq, f"{run} {stream} {seq} ".encode() * 20, samples=1)
        seq += 1
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
    os.write(1, f"{entry.payload[:40].decode()}\\n".encode())
    spool.ack(entry.id)
    if run != "last" and count % 300 == 0:
        last = 0
spool.close()
os.write(1, b"end\\n")
"""


def test_kill_9_at_random_moments_loses_no_published_batch_and_names_the_last_of_every_run(
    path: Path,
) -> None:
    chance = random.Random(7)
    arrived: dict[str, dict[str, list[int]]] = {"a": {}, "b": {}}
    named: dict[str, dict[str, int]] = {"a": {}, "b": {}}
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
            first, second, *rest = line.split()
            if second == "before":
                ends = (each.partition(":") for each in rest)
                named[first].update((boot, int(seq)) for boot, _, seq in ends)
                continue
            numbers = arrived[second].setdefault(first, [])
            if int(rest[0]) not in numbers[-2000:]:
                numbers.append(int(rest[0]))
            if run != "last" and i == lines:
                victim.kill()
        victim.stdout.close()
        victim.kill()
        victim.wait()
        assert complete == (run == "last")
    for stream, runs in arrived.items():
        for run, seqs in runs.items():
            assert seqs == list(range(len(seqs))), f"{stream}: each one, in order, without a hole"
            # All that was durable has arrived, and the next run said how much that was.
            assert named[stream][run] == seqs[-1]
        assert len(runs) > 10
        assert sum(map(len, runs.values())) > 500


# --- parts --------------------------------------------------------------------------------------------


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


def test_the_configuration_makes_the_spool(path: Path) -> None:
    spool = make_spool(QueueConfig(path=path, durability=FULL), SystemClock())
    assert isinstance(spool, SqliteSpool)
    spool.put("vesc", BOOT, 0, b"x", samples=1)
    spool.close()
    assert isinstance(make_spool(QueueConfig(), SystemClock()), MemorySpool)
    assert path.stat().st_size > 0
