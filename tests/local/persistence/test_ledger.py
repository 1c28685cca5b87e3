"""The ledger: what it keeps, what it undoes, and who is told."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress

import pytest

from local.deployment import ROOT
from local.persistence import ledger as ledger_module
from local.persistence.ledger import VERSION, Ledger, LedgerError, settle
from testkit.waiting import GUARD_S


@pytest.fixture
def ledger(tmp_path):
    made = Ledger(tmp_path / "ledger.db", sync="normal")
    made.define("CREATE TABLE IF NOT EXISTS n (n INTEGER PRIMARY KEY, text TEXT)")
    made.commit()
    yield made
    made.close()


def put(ledger, *numbers):
    with ledger.write() as connection:
        for n in numbers:
            connection.execute("INSERT INTO n VALUES (?, ?)", (n, "x" * 1000))


def held(ledger):
    return [n for (n,) in ledger.read("SELECT n FROM n ORDER BY n")]


def stored(ledger):
    """What another process would find."""
    with closing(sqlite3.connect(ledger.path)) as other:
        return [n for (n,) in other.execute("SELECT n FROM n ORDER BY n")]


def test_changes_are_stored_together_at_the_commit(ledger):
    put(ledger, 1)
    put(ledger, 2, 3)
    assert (held(ledger), stored(ledger)) == ([1, 2, 3], [])
    assert ledger.pending
    ledger.commit()
    assert stored(ledger) == [1, 2, 3]
    assert not ledger.pending


def test_an_exception_undoes_its_own_change_only(ledger):
    forgotten = []
    ledger.on_undo.append(lambda: forgotten.append(held(ledger)))
    since = ledger.undone
    put(ledger, 1)
    with suppress(KeyError), ledger.write():
        put(ledger, 2)
        raise KeyError
    ledger.commit(since)
    assert (stored(ledger), forgotten) == ([1], [[1]])


def test_nobody_commits_in_the_middle_of_a_change(ledger):
    with ledger.write():
        put(ledger, 1)
        with pytest.raises(RuntimeError):
            ledger.read_committed("SELECT n FROM n")
    assert ledger.read_committed("SELECT n FROM n") == [(1,)]


def test_a_full_file_undoes_everything_and_tells_everybody(ledger):
    forgotten = []
    ledger.on_undo.append(lambda: forgotten.append(held(ledger)))
    put(ledger, 1)
    ledger.commit()
    since = ledger.undone
    put(ledger, 2)
    (pages,) = ledger.read("PRAGMA page_count")[0]
    ledger.read(f"PRAGMA max_page_count = {pages}")
    with pytest.raises(LedgerError, match="full"):
        put(ledger, *range(3, 100))
    assert (held(ledger), forgotten) == ([1], [[1]])
    ledger.read("PRAGMA max_page_count = 1000000")
    put(ledger, 4)
    with pytest.raises(LedgerError, match="try again"):
        ledger.commit(since)
    assert stored(ledger) == [1, 4]
    ledger.commit(ledger.undone)


FULL_AT_COMMIT = """
import resource, sys
from pathlib import Path
from local.persistence.ledger import Ledger, LedgerError

ledger = Ledger(Path(sys.argv[1]))
ledger.define("CREATE TABLE n (n INTEGER PRIMARY KEY, text TEXT)")
def put(n):
    with ledger.write() as connection:
        connection.execute("INSERT INTO n VALUES (?, ?)", (n, "x" * 50_000))
put(1)
ledger.commit()
resource.setrlimit(resource.RLIMIT_FSIZE, (80_000, resource.RLIM_INFINITY))
put(2)
try:
    ledger.commit()
except LedgerError:
    assert ledger.read("SELECT n FROM n") == [(1,)]
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    put(3)
    ledger.commit()
    assert ledger.read("PRAGMA integrity_check") == [("ok",)]
    print(ledger.read("SELECT n FROM n"))
"""


def test_a_commit_without_room_on_the_disk_is_undone(tmp_path):
    command = [sys.executable, "-c", FULL_AT_COMMIT, str(tmp_path / "ledger.db")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=GUARD_S, check=False)
    assert done.stdout == "[(1,), (3,)]\n", done.stderr


KILLED = """
import sys, time
from pathlib import Path
from local.persistence.ledger import Ledger

ledger = Ledger(Path(sys.argv[1]), sync="normal")
ledger.define("CREATE TABLE n (n INTEGER PRIMARY KEY, text TEXT)")
for n in range(1_000_000):
    with ledger.write() as connection:
        connection.execute("INSERT INTO n VALUES (?, ?)", (n, "x"))
    ledger.commit()
    print(n, flush=True)
"""


def test_what_was_committed_survives_sigkill_and_damage_to_the_settled_file_shows(tmp_path):
    path = tmp_path / "ledger.db"
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as writer:
        said = [next(writer.stdout) for _ in range(200)]
        writer.send_signal(signal.SIGKILL)
        said += writer.stdout.read().splitlines()
    settle(path)
    assert [one.name for one in tmp_path.iterdir()] == ["ledger.db"]
    with closing(sqlite3.connect(path)) as opened:
        found = [n for (n,) in opened.execute("SELECT n FROM n ORDER BY n")]
    # The last line may be cut; a commit may have been stored that nobody was told of.
    told = len(said) - 1
    assert told >= 199
    assert found == list(range(len(found)))
    assert len(found) >= told
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(LedgerError, match=r"cannot open .*ledger\.db: .*malformed"):
        Ledger(path)


def test_one_fsync_serves_all_who_wait(tmp_path, monkeypatch):
    ledger = Ledger(tmp_path / "ledger.db", sync="full")
    ledger.define("CREATE TABLE n (n INTEGER PRIMARY KEY, text TEXT)")
    ledger.commit()
    running, go_on, synced = threading.Event(), threading.Event(), []

    def fdatasync(_file):
        running.set()
        assert go_on.wait(GUARD_S)
        synced.append(stored(ledger))

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    put(ledger, 0)
    threads = [threading.Thread(target=ledger.commit)]
    threads[0].start()
    assert running.wait(GUARD_S)
    for n in range(1, 10):
        # The disk is busy, and others go on writing.
        put(ledger, n)
        threads.append(threading.Thread(target=ledger.commit))
        threads[-1].start()
    while len(stored(ledger)) < 10:
        time.sleep(0.001)
    go_on.set()
    for thread in threads:
        thread.join(GUARD_S)
    assert len(synced) == 2
    assert synced[1] == list(range(10))
    ledger.close()


def test_a_failing_disk_is_not_asked_again(tmp_path, monkeypatch):
    ledger = Ledger(tmp_path / "ledger.db", sync="full")
    ledger.define("CREATE TABLE n (n INTEGER PRIMARY KEY, text TEXT)")
    asked = []

    def fdatasync(file):
        asked.append(file)
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    put(ledger, 1)
    for _ in range(2):
        with pytest.raises(LedgerError, match="Input/output error"):
            ledger.commit()
    assert len(asked) == 1
    with pytest.raises(LedgerError):
        ledger.close()


def test_the_log_stays_small(tmp_path, monkeypatch):
    monkeypatch.setattr(ledger_module, "_LOOK_S", 0.01)
    monkeypatch.setattr(ledger_module, "_WAL_BYTES", 100_000)
    ledger = Ledger(tmp_path / "ledger.db")
    ledger.define("CREATE TABLE n (n INTEGER PRIMARY KEY, text TEXT)")
    put(ledger, *range(1000))
    ledger.commit()
    wal = tmp_path / "ledger.db-wal"
    deadline = time.monotonic() + 60
    while wal.stat().st_size > 100_000:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert len(stored(ledger)) == 1000
    ledger.close()


def test_a_newer_file_is_refused(tmp_path):
    path = tmp_path / "ledger.db"
    with closing(sqlite3.connect(path)) as other:
        other.execute(f"PRAGMA user_version = {VERSION + 1}")
    with pytest.raises(LedgerError, match="upgrade iort"):
        Ledger(path)


def test_the_record_lane_leaves_room_on_the_disk(tmp_path):
    disk = os.statvfs(tmp_path)
    ledger = Ledger(tmp_path / "ledger.db", floor_bytes=disk.f_bavail * disk.f_frsize * 2)
    with pytest.raises(LedgerError, match="MB free"):
        ledger.check_room()
    ledger.floor_bytes = 0
    ledger.check_room()
    ledger.close()


def test_changes_are_pending_until_their_commit_is_over(ledger):
    with closing(sqlite3.connect(ledger.path)) as other:
        for n in range(20):
            with ledger.write() as connection:
                # It is written by the commit, which takes a while.
                connection.execute("INSERT INTO n VALUES (?, ?)", (n, "x" * 1_500_000))
            committing = threading.Thread(target=ledger.commit)
            committing.start()
            while ledger.pending:
                pass
            found = other.execute("SELECT count(*) FROM n").fetchone()
            committing.join()
            assert found == (n + 1,)


def test_what_others_committed_is_pending_until_it_is_on_the_disk(tmp_path):
    with closing(Ledger(tmp_path / "ledger.db", sync="full")) as ledger:
        ledger.define("CREATE TABLE IF NOT EXISTS n (n INTEGER PRIMARY KEY, text TEXT)")
        put(ledger, 1)
        assert ledger.read_committed("SELECT n FROM n") == [(1,)]
        assert ledger.pending
        ledger.commit()
        assert not ledger.pending


def test_the_name_of_a_new_file_survives_a_power_cut(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda file: synced.append(os.fstat(file).st_ino))
    Ledger(tmp_path / "ledger.db", sync="full").close()
    assert synced == [tmp_path.stat().st_ino]
