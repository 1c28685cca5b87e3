"""The spool on disk: restarts and crashes; test_device_spool_trouble.py has its disk fail."""

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

from iort_agent.clock import SystemClock
from iort_agent.spool import disk
from iort_agent.spool.config import QueueConfig
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.ledger import Ledger
from iort_agent.spool.memory import FULL, PROCESS, REJECT_NEW, Entry, MemorySpool
from iort_agent.spool.reservation import BLOCK, Reservation
from iort_agent.spool.sqlite import SqliteSpool, make_spool
from tests.agent_fakes import ManualClock
from tests.unit.agent.test_spool import fill, following, kept

ROOT = Path(__file__).parents[3]
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
    spool._disk.close()
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
        assert spool._disk.file is not None
        assert spool._disk.file._number("synchronous") == synchronous
        assert spool._disk.file._db.execute("PRAGMA journal_mode").fetchone() == ("wal",)


@pytest.mark.parametrize("durability", [PROCESS, FULL])
def test_after_a_power_cut_numbers_that_may_have_been_used_are_not(
    path: Path, tmp_path: Path, durability: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk, "_machine", lambda: "first")
    spool = spool_at(path, durability=durability)
    fill(spool, 5)
    spool.flush()
    # With PROCESS, the kernel may not have written what the database says it has: go back in time.
    survived = crash(spool, tmp_path)
    monkeypatch.setattr(disk, "_machine", lambda: "second")
    if durability == PROCESS:
        for file in survived.parent.glob("spool.db-wal"):
            file.write_bytes(b"")
    with running(survived, durability=durability) as spool:
        assert spool.next_seq("vesc") == (5 if durability == FULL else 5 + BLOCK)
        assert spool.alarm is None
        fill(spool, 1)
    monkeypatch.setattr(disk, "_machine", lambda: "third")
    with running(survived, durability=durability) as spool:
        assert spool.next_seq("vesc") == (6 if durability == FULL else 6 + BLOCK), "it was closed"


def test_acknowledgements_and_puts_are_written_in_groups(path: Path) -> None:
    spool = spool_at(path, clock=SystemClock())
    commits: list[int] = []
    assert spool._disk.file is not None
    write = spool._disk.file.commit

    def count(entries: Any, **more: Any) -> None:
        commits.append(len(entries))
        write(entries, **more)

    spool._disk.file.commit = count
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
            assert spool._stock.window.payload_bytes < 5 * MB, "memory is bounded"
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
from iort_agent.clock import SystemClock
from iort_agent.spool.sqlite import SqliteSpool

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


# --- parts --------------------------------------------------------------------------------------------


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
    spool = make_spool(QueueConfig(path=path, durability=FULL), SystemClock())
    assert isinstance(spool, SqliteSpool)
    spool.put("vesc", 0, b"x", samples=1)
    spool.close()
    assert isinstance(make_spool(QueueConfig(), SystemClock()), MemorySpool)
