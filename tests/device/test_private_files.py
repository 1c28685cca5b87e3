"""What the agent reads and writes in a folder where somebody else may put links, pipes and files too."""

from __future__ import annotations

import contextlib
import io
import os
import stat
import threading
from pathlib import PurePath

import pytest

from iort_agent.cli import main
from iort_agent.errors import UploadError
from iort_agent.files.file import from_json, read, to_json
from iort_agent.files.folder import STATE, Folder
from iort_agent.lanes.attachment import ClaimCheck
from iort_agent.private_files import make_private, open_below, write_below
from iort_agent.spool.file import SpoolFile
from iort_agent.spool.interface import PROCESS
from iort_agent.spool.sqlite import RETRY_S, SqliteSpool
from iort_contract.catalog.vesc import VESC_STREAM
from tests.agent_fakes import ManualClock
from tests.unit.agent.test_agent import config_file

SECRET = b"another's, and not for the bucket"


@pytest.fixture
def secret(tmp_path):
    """A file that links lead to; it is as it was at the end."""
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
    """As a supervisor may start the agent."""
    before = os.umask(0)
    yield
    os.umask(before)


def watched(folder, *, remove_after_s=None):
    return Folder(folder, clock=ManualClock(), settle_s=0, remove_after_s=remove_after_s)


def modes(folder):
    return {stat.S_IMODE(path.lstat().st_mode) for path in folder.rglob("*") if path.is_file()}


def test_a_link_in_the_place_of_what_is_written_leads_nowhere(folder, secret):
    for name in (STATE, f"{STATE}.tmp"):
        (folder / name).symlink_to(secret)
    (folder / "a.bag").write_bytes(b"1")
    files = watched(folder)
    name = files.next()
    files.uploaded(name, files.local(name, threading.Event()), "key")
    assert not (folder / STATE).is_symlink()
    # It was kept, and is found again.
    assert watched(folder).next() is None


def test_a_file_that_became_a_link_is_neither_read_nor_sent(folder, secret):
    name, stop = PurePath("drive/a.bag"), threading.Event()
    path = folder / name
    path.parent.mkdir()
    path.write_bytes(b"1")
    local = read(folder, name, stop=stop)
    saved = to_json(local)
    path.unlink()
    path.symlink_to(secret)
    with pytest.raises(UploadError, match=r"a\.bag"):
        read(folder, name, stop=stop)
    with pytest.raises(OSError, match="symbolic"):
        local.open()
    assert from_json(folder, name, saved) is None
    # And one whose folder became a link.
    path.unlink()
    path.parent.rmdir()
    path.parent.symlink_to(secret.parent)
    for gone in (name, PurePath("drive/secret")):
        with pytest.raises(UploadError, match="drive"):
            read(folder, gone, stop=stop)
        with pytest.raises(OSError, match="directory"):
            open_below(folder, gone)


def test_a_pipe_in_the_place_of_a_file_is_not_waited_for(folder):
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
    files.uploaded(name, local, "key")
    assert secret.exists()


def test_claims_are_written_where_they_belong(folder, secret):
    (folder / "camera").symlink_to(secret.parent)
    claims = ClaimCheck(
        robot="car", folder=folder, every_s=0, max_bytes=1000, clock=ManualClock(),
        thumbnail=lambda _content, _type: None, stored=lambda: None,
    )  # fmt: skip
    assert set(claims.claim_fields("camera", 1, {"image": b"x"}).values()) == {None}
    assert claims.claim_fields("lidar", 1, {"scan": b"x"})["scan.size"] == 1
    assert claims.report()["left_out"] == 1


def test_what_is_written_is_its_owners_alone_whatever_the_umask(folder, open_umask):
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
    files.local(files.next(), threading.Event())
    assert (folder / "uploads" / STATE).exists()
    claims = ClaimCheck(
        robot="car", folder=folder, every_s=0, max_bytes=1000, clock=clock,
        thumbnail=lambda _content, _type: None, stored=lambda: None,
    )  # fmt: skip
    claims.claim_fields("lidar", 1, {"scan": b"x"})
    assert modes(folder) == {0o600}
    assert stat.S_IMODE((folder / "lidar").stat().st_mode) == 0o700


def test_a_queue_that_anybody_may_read_is_closed(folder):
    path = folder / "queue.db"
    SpoolFile(path, PROCESS).close()
    path.chmod(0o644)
    SpoolFile(path, PROCESS).close()
    assert modes(folder) == {0o600}


@pytest.mark.parametrize(
    "name", ["queue.db", "queue.db-wal", "queue.db-shm", "queue.db.lock", "queue.db.seq"]
)
def test_a_link_in_the_place_of_the_queue_is_said_and_batches_go_out(folder, secret, name):
    (folder / name).symlink_to(secret)
    clock = ManualClock()
    spool = SqliteSpool(folder / "queue.db", max_bytes=10**6, clock=clock)
    assert name in spool.alarm
    spool.put(VESC_STREAM, "0badcafe", 0, b"payload", samples=1)
    spool.work()
    assert spool.next(0).payload == b"payload"
    # It is taken away: everything is written.
    (folder / name).unlink()
    clock.advance(RETRY_S)
    spool.work()
    assert spool.alarm is None
    spool.close()


def test_a_file_is_whole_or_not_there(folder):
    write_below(folder, PurePath("a/b"), b"1", mode=0o640, mtime_ns=1_000)
    assert (folder / "a" / "b").stat().st_mtime_ns == 1_000
    assert stat.S_IMODE((folder / "a" / "b").stat().st_mode) == 0o640
    (folder / "full").mkdir()
    with pytest.raises(OSError, match="directory"):
        write_below(folder, PurePath("full"), b"1")
    assert sorted(path.name for path in folder.rglob("*")) == ["a", "b", "full"]
    make_private(folder / "a" / "b")
    assert (folder / "a" / "b").read_bytes() == b"1"


class Asking(io.StringIO):
    """Standard output that notes with which umask it is written to."""

    def __init__(self):
        super().__init__()
        self.umasks = set()

    def write(self, text):
        umask = os.umask(0o077)
        os.umask(umask)
        self.umasks.add(umask)
        return super().write(text)


def test_whatever_a_command_writes_is_its_users_alone(tmp_path, open_umask):
    asking = Asking()
    with contextlib.redirect_stdout(asking):
        assert main(["--config", str(config_file(tmp_path, "{type: sim}")), "--check-config"]) == 0
    assert asking.umasks == {0o077}
    assert os.umask(0) == 0
