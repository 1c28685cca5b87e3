"""Backups of a kept cloud that is written to, and what a restore accepts."""

from __future__ import annotations

import fcntl
import gzip
import os
import shutil
import sqlite3
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from iort_station.errors import StationError
from iort_station.upkeep import backup
from iort_station.upkeep.backup import back_up, restore, verify
from iort_station.upkeep.snapshot import held
from testkit.waiting import GUARD_S

# As the cloud does it: a file is whole before the ledger names it.
WRITER = """
import os, sqlite3, sys, time
from pathlib import Path
folder = Path(sys.argv[1])
ledger = sqlite3.connect(folder / "ledger.db", isolation_level=None)
ledger.execute("PRAGMA journal_mode = WAL")
ledger.execute("CREATE TABLE written (number INTEGER PRIMARY KEY, pad TEXT)")
for number in range(1_000_000):
    (folder / "s3" / f"{number}.tmp").write_text(str(number))
    os.replace(folder / "s3" / f"{number}.tmp", folder / "s3" / str(number))
    (folder / "newest.tmp").write_text(str(number))
    os.replace(folder / "newest.tmp", folder / "newest")
    ledger.execute("INSERT INTO written VALUES (?, ?)", (number, "x" * 5000))
    if number % 50 == 49:
        print(number, flush=True)
    time.sleep(0.01)
"""


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state folder, and what no backup has."""
    folder = tmp_path / "cloud"
    for name in ("s3", "tmp"):
        (folder / name).mkdir(parents=True)
    for name in ("VERSION", "authority.key", "up.json", "emulator.log", "tmp/used"):
        (folder / name).write_text("1\n")
    (folder / "authority.key").chmod(0o600)
    return folder


@pytest.fixture
def written(state: Path) -> Iterator[None]:
    """A process that writes to the state all the time."""
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(state)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    assert writer.stdout.readline() == "49\n"
    yield
    writer.kill()
    writer.communicate()


def test_a_backup_of_a_cloud_that_is_written_to_is_of_one_moment(
    state: Path, written: None, tmp_path: Path
) -> None:
    told: list[int] = []
    for attempt in range(3):
        archive, restored = tmp_path / f"{attempt}.tar", tmp_path / f"restored{attempt}"
        made = back_up(state, archive, progress=told.append)
        assert archive.stat().st_mode & 0o777 == 0o600
        assert sum(told) >= made.size
        restore(archive, restored)
        with closing(sqlite3.connect(restored / "ledger.db")) as ledger:
            numbers = [number for (number,) in ledger.execute("SELECT number FROM written")]
        assert numbers == list(range(len(numbers)))
        assert len(numbers) >= 50
        assert [(restored / "s3" / str(number)).read_text() for number in numbers] == list(map(str, numbers))
        # The file is replaced before the ledger's row is written.
        assert int((restored / "newest").read_text()) - len(numbers) in (-1, 0)
        assert (restored / "authority.key").stat().st_mode & 0o777 == 0o600
        assert not {"up.json", "emulator.log", "tmp", ".backup"} & {one.name for one in restored.iterdir()}
    assert not (state / ".backup").exists()


def test_the_next_backup_removes_what_a_killed_one_has_left(state: Path, tmp_path: Path) -> None:
    with closing(sqlite3.connect(state / "ledger.db")) as ledger:
        ledger.execute("CREATE TABLE written (number INTEGER PRIMARY KEY)")
    backups = tmp_path / "back[1]ups"
    backups.mkdir()
    code = (
        "import os, signal, sys; from pathlib import Path; from iort_station.upkeep.backup import back_up\n"
        "def kill(_bytes): os.kill(os.getpid(), signal.SIGKILL)\n"
        "back_up(Path(sys.argv[1]), Path(sys.argv[2]), progress=kill)"
    )
    archive = backups / "cloud.tar"
    subprocess.run([sys.executable, "-c", code, str(state), str(archive)], check=False, timeout=GUARD_S)
    assert len(list(backups.iterdir())) == 2
    # One that another process is writing, and a file of somebody's.
    others = {backups / ".cloud.tar.1.part", backups / ".cloud.tar.notes"}
    for other in others:
        other.touch()
    with (backups / ".cloud.tar.1.part").open() as written:
        fcntl.flock(written, fcntl.LOCK_EX)
        back_up(state, archive)
    assert set(backups.iterdir()) == {archive, *others}
    verify(archive)


def test_a_robots_files_are_copied_byte_by_byte_whatever_their_names(state: Path, tmp_path: Path) -> None:
    files = state / "s3" / "files"
    for name in ("vesc.log", "up.json", "tmp/drive.bag", "notes-wal"):
        (files / name).parent.mkdir(parents=True, exist_ok=True)
        (files / name).write_text(name)
    # A bag of ROS 2 is a database that nobody may open, or its hash changes.
    with closing(sqlite3.connect(files / "drive.db3")) as bag:
        bag.execute("PRAGMA journal_mode = WAL")
        bag.execute("CREATE TABLE messages (data BLOB)")
    (files / "unfinished.bag.tmp").write_text("half")
    back_up(state, tmp_path / "cloud.tar")
    restore(tmp_path / "cloud.tar", tmp_path / "restored")
    original, copied = (
        {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*.*")
            if path.is_file()
        }
        for folder in (files, tmp_path / "restored" / "s3" / "files")
    )
    del original["unfinished.bag.tmp"]
    assert original == copied
    assert (tmp_path / "restored" / "s3" / "files" / "notes-wal").exists()


def test_a_file_system_without_links_gets_copies(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError("no links here")

    monkeypatch.setattr(os, "link", refuse)
    assert set(back_up(state, tmp_path / "cloud.tar").files) == {"VERSION", "authority.key"}


def test_a_damaged_backup_changes_nothing(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "cloud.tar"
    with pytest.raises(StationError, match="must be in a folder that exists"):
        back_up(state, tmp_path / "nowhere" / "cloud.tar")
    (state / "s3" / "drive.bag").write_bytes(b"drive" * 1000)
    back_up(state, archive)
    good = archive.read_bytes()
    archive.write_bytes(gzip.compress(good))
    assert verify(archive).files.keys() == {"VERSION", "authority.key", "s3/drive.bag"}
    archive.write_bytes(good)
    with tarfile.open(archive) as tar:
        manifest_at = tar.getmember("manifest.json").offset
    for damaged, reason in (
        (
            good.replace(b"drivedrive", b"driveDrive", 1),
            "1 files are not as they were saved, such as s3/drive.bag",
        ),
        (good[:2000], "is damaged, or no backup"),
        (good[:manifest_at] + bytes(1024), "its list of hashes is missing"),
        (gzip.compress(good)[:-100], "is damaged, or no backup"),
        (b"anything", "is damaged, or no backup"),
    ):
        archive.write_bytes(damaged)
        with pytest.raises(StationError, match=reason):
            restore(archive, tmp_path / "new")
    # Nothing is written outside of the folder.
    with tarfile.open(archive, "w") as tar:
        tar.add(state / "VERSION", "../VERSION")
    with pytest.raises(StationError, match=r"got the member '../VERSION'"):
        restore(archive, tmp_path / "new")
    assert {one.name for one in tmp_path.iterdir()} <= {"cloud", "cloud.tar", "new.lock"}


def test_a_restore_does_not_touch_a_state_that_is_there(state: Path, tmp_path: Path) -> None:
    archive = tmp_path / "cloud.tar"
    back_up(state, archive)
    (state / "since").write_text("1")
    with pytest.raises(StationError, match="--force, which renames it"):
        restore(archive, state)
    with held(state), pytest.raises(StationError, match=r"a cloud runs in .*: stop it first"):
        restore(archive, state, force=True)
    _, earlier = restore(archive, state, force=True)
    assert earlier is not None
    assert (earlier / "since").exists()
    assert not (state / "since").exists()
    with pytest.raises(StationError, match="has no kept cloud"):
        back_up(tmp_path / "nothing", tmp_path / "other.tar")


def test_a_backup_overwrites_nothing_and_needs_room(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    archive = tmp_path / "cloud.tar"
    archive.write_text("mine")
    with pytest.raises(StationError, match="exists"):
        back_up(state, archive)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1_000))
    with pytest.raises(StationError, match=r"must have 1\.0 GB free for this, got 0\.0 GB"):
        back_up(state, archive, force=True)
    assert archive.read_text() == "mine"


def test_a_backup_of_another_format_or_with_a_broken_database_is_not_restored(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "broken"
    with closing(sqlite3.connect(broken)) as database:
        database.execute("CREATE TABLE n (n)")
        database.commit()
    broken.write_bytes(broken.read_bytes()[:4096] + b"x" * 4096)
    files = {"VERSION": state / "VERSION", "ledger.db": broken}
    with (tmp_path / "cloud.tar").open("wb") as archive:
        backup._write(archive, files, 0.0, lambda _bytes: None)
    with pytest.raises(StationError, match=r"database ledger\.db is damaged"):
        restore(tmp_path / "cloud.tar", tmp_path / "restored")
    with monkeypatch.context() as later:
        later.setattr(backup, "FORMAT", 2)
        back_up(state, tmp_path / "newer.tar")
    with pytest.raises(StationError, match="must have format 1, got 2"):
        restore(tmp_path / "newer.tar", tmp_path / "restored")
    assert not (tmp_path / "restored").exists()
