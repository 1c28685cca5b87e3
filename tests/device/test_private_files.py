"""Reading and writing in a folder where others may put links, pipes and files."""

from __future__ import annotations

import contextlib
import io
import os
import stat
import threading
from pathlib import PurePath

import pytest

from iort_agent.cli import main
from iort_agent.common.private_files import make_private, open_below, write_below
from iort_agent.errors import UploadError
from iort_agent.files.file import read
from iort_agent.files.folder import STATE, FilesConfig, Folder
from iort_agent.lanes.attachment import Attachments
from iort_agent.spool import PROCESS
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.sqlite import RETRY_S, SqliteSpool
from iort_contract.catalog.vesc import VESC_STREAM
from testkit.agent import ManualClock
from tests.unit.agent.test_agent import config_file

SECRET = b"another's, and not for the bucket"

LARGE = FilesConfig(large_every_s=0, large_max_mb=0.001)


@pytest.fixture
def secret(tmp_path):
    """The target of the links; it must not change."""
    path = tmp_path / "elsewhere" / "secret"
    path.parent.mkdir()
    path.write_bytes(SECRET)
    yield path
    assert path.read_bytes() == SECRET
    assert [found.name for found in path.parent.iterdir()] == ["secret"]


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "folder"
    path.mkdir()
    return path


@pytest.fixture
def open_umask():
    """The umask with which a supervisor may start the agent."""
    before = os.umask(0)
    yield
    os.umask(before)


def watched(folder, *, remove_after_s=None):
    return Folder(folder, clock=ManualClock(), settle_s=0, remove_after_s=remove_after_s)


def modes(folder):
    return {stat.S_IMODE(path.lstat().st_mode) for path in folder.rglob("*") if path.is_file()}


def test_a_link_in_place_of_a_written_file_is_replaced(folder, secret):
    for name in (STATE, f"{STATE}.tmp"):
        (folder / name).symlink_to(secret)
    (folder / "a.bag").write_bytes(b"1")
    files = watched(folder)
    name = files.next()
    files.uploaded(name, files.local(name, threading.Event()))
    assert not (folder / STATE).is_symlink()
    # The state was kept and is read again.
    assert watched(folder).next() is None


def test_a_folder_is_looked_through_once_for_many_files(folder):
    for name in ("b.jpg", "c.jpg", "d.jpg"):
        (folder / name).write_bytes(b"1")
    clock = ManualClock()
    files = Folder(folder, clock=clock, settle_s=0, remove_after_s=None)
    first = files.next()
    # Older than all: only another look would see it.
    (folder / "a.jpg").write_bytes(b"1")
    os.utime(folder / "a.jpg", (1, 1))
    assert files.next() == first
    files.uploaded(first, files.local(first, threading.Event()))
    second = files.next()
    assert second not in {None, first, PurePath("a.jpg")}
    (folder / second).write_bytes(b"changed since the look")
    third = files.next()
    assert third not in {None, first, second, PurePath("a.jpg")}
    clock.advance(60)
    assert files.next() == PurePath("a.jpg"), "and looked at again while files wait"


def test_the_state_of_a_folder_costs_the_same_for_every_file(folder):
    count = 300
    for number in range(count):
        (folder / f"{number:04d}.jpg").write_bytes(b"1")
    files = watched(folder)
    inodes, sizes = set(), [0]
    for _ in range(count):
        name = files.next()
        files.uploaded(name, files.local(name, threading.Event()))
        written = (folder / STATE).stat()
        inodes.add(written.st_ino)
        sizes.append(written.st_size)
    assert len(inodes) == 1, "it is never written anew"
    steps = {after - before for before, after in zip(sizes, sizes[1:])}
    assert max(steps) < 200
    assert max(steps) - min(steps) < 5, "a line each"
    assert watched(folder).next() is None
    # Killed in the middle of a line, which the next one does not continue.
    with (folder / STATE).open("a") as state:
        state.write('["0000.jpg", nu')
    (folder / "more.jpg").write_bytes(b"1")
    again = watched(folder)
    name = again.next()
    assert str(name) == "more.jpg"
    again.uploaded(name, again.local(name, threading.Event()))
    assert watched(folder).next() is None
    # Lines of files that are gone do not stay for ever.
    for _ in range(4):
        for path in folder.glob("*.jpg"):
            path.unlink()
        assert again.next() is None
        for number in range(count):
            (folder / f"{number:04d}.jpg").write_bytes(b"1")
        for _ in range(count):
            name = again.next()
            again.uploaded(name, again.local(name, threading.Event()))
    assert len((folder / STATE).read_text().splitlines()) <= 1000 + 2 * count


def test_a_file_that_became_a_link_is_neither_read_nor_sent(folder, secret):
    name, stop = PurePath("drive/a.bag"), threading.Event()
    path = folder / name
    path.parent.mkdir()
    path.write_bytes(b"1")
    local = read(folder, name, stop=stop)
    path.unlink()
    path.symlink_to(secret)
    with pytest.raises(UploadError, match=r"a\.bag"):
        read(folder, name, stop=stop)
    with pytest.raises(OSError, match="symbolic"):
        local.open()
    # The same for a file whose folder became a link.
    path.unlink()
    path.parent.rmdir()
    path.parent.symlink_to(secret.parent)
    for gone in (name, PurePath("drive/secret")):
        with pytest.raises(UploadError, match="drive"):
            read(folder, gone, stop=stop)
        with pytest.raises(OSError, match="directory"):
            open_below(folder, gone)


def test_a_pipe_in_place_of_a_file_does_not_block(folder):
    os.mkfifo(folder / "a.bag")
    os.mkfifo(folder / STATE)
    with pytest.raises(OSError, match="no regular file"):
        open_below(folder, PurePath("a.bag"))
    with pytest.raises(UploadError, match="no regular file"):
        read(folder, PurePath("a.bag"), stop=threading.Event())
    assert watched(folder).next() is None


def test_nothing_is_removed_through_a_link(folder, secret):
    path = folder / "drive" / secret.name
    path.parent.mkdir()
    path.write_bytes(SECRET)
    status = secret.stat()
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    files = watched(folder, remove_after_s=0)
    name = files.next()
    local = files.local(name, threading.Event())
    path.unlink()
    path.parent.rmdir()
    path.parent.symlink_to(secret.parent)
    files.uploaded(name, local)
    assert secret.exists()


def test_attachments_are_written_only_below_their_folder(folder, secret):
    (folder / "camera").symlink_to(secret.parent)
    attachments = Attachments(
        "car", folder, LARGE, ManualClock(), stored=lambda: None, thumbnail=lambda *_: None
    )
    assert set(attachments.attach_to_fields("camera", 1, {"image": b"x"}).values()) == {None}
    assert attachments.attach_to_fields("lidar", 1, {"scan": b"x"})["scan.size"] == 1
    assert attachments.report()["left_out"] == 1


def test_only_the_owner_may_read_written_files_with_any_umask(folder, open_umask):
    clock = ManualClock()
    spool = SqliteSpool(folder / "queue.db", max_bytes=10**6, clock=clock)
    spool.put(VESC_STREAM, "0badcafe", 0, b"payload", samples=1)
    spool.work()
    # With its log, while it is open.
    assert modes(folder) == {0o600}
    assert len(list(folder.iterdir())) == 4
    spool.close()
    (folder / "uploads").mkdir()
    (folder / "uploads" / "a.bag").write_bytes(b"1")
    (folder / "uploads" / "a.bag").chmod(0o600)
    files = watched(folder / "uploads")
    name = files.next()
    files.uploaded(name, files.local(name, threading.Event()))
    assert (folder / "uploads" / STATE).exists()
    attachments = Attachments("car", folder, LARGE, clock, stored=lambda: None, thumbnail=lambda *_: None)
    attachments.attach_to_fields("lidar", 1, {"scan": b"x"})
    assert modes(folder) == {0o600}
    assert stat.S_IMODE((folder / "lidar").stat().st_mode) == 0o700


def test_a_readable_queue_is_made_private(folder):
    path = folder / "queue.db"
    SpoolFile(path, PROCESS).close()
    path.chmod(0o644)
    SpoolFile(path, PROCESS).close()
    assert modes(folder) == {0o600}


@pytest.mark.parametrize("name", ["queue.db", "queue.db-wal", "queue.db-shm", "queue.db.lock"])
def test_a_link_in_place_of_the_queue_is_reported_and_batches_are_sent(folder, secret, name):
    (folder / name).symlink_to(secret)
    clock = ManualClock()
    spool = SqliteSpool(folder / "queue.db", max_bytes=10**6, clock=clock)
    assert name in spool.alarm
    spool.put(VESC_STREAM, "0badcafe", 0, b"payload", samples=1)
    spool.work()
    assert spool.next(0).payload == b"payload"
    # Everything is written once the link is removed.
    (folder / name).unlink()
    clock.advance(RETRY_S)
    spool.work()
    assert spool.alarm is None
    spool.close()


def test_a_file_is_complete_or_absent(folder):
    write_below(folder, PurePath("a/b"), b"1", mode=0o640, mtime_ns=1_000)
    assert (folder / "a" / "b").stat().st_mtime_ns == 1_000
    assert stat.S_IMODE((folder / "a" / "b").stat().st_mode) == 0o640
    (folder / "full").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_below(folder, PurePath("full"), b"1")
    assert sorted(path.name for path in folder.rglob("*")) == ["a", "b", "full"]
    make_private(folder / "a" / "b")
    assert (folder / "a" / "b").read_bytes() == b"1"


class UmaskRecorder(io.StringIO):
    """Standard output that notes with which umask it is written to."""

    def __init__(self):
        super().__init__()
        self.umasks = set()

    def write(self, text):
        umask = os.umask(0o077)
        os.umask(umask)
        self.umasks.add(umask)
        return super().write(text)


def test_only_the_user_may_read_what_a_command_writes(tmp_path, open_umask):
    asking = UmaskRecorder()
    with contextlib.redirect_stdout(asking):
        assert main(["--config", str(config_file(tmp_path, "{type: sim}")), "--check-config"]) == 0
    assert asking.umasks == {0o077}
    assert os.umask(0) == 0
