"""Uploads to a fake store that fails, rejects and forgets."""

from __future__ import annotations

import hashlib
import io
import os
import threading
from dataclasses import replace
from pathlib import Path, PurePath

import pytest
from mcap.reader import make_reader

from iort_agent.agent import Agent
from iort_agent.common.state import Files
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config, load_config, without_sources
from iort_agent.errors import UploadError
from iort_agent.files.file import kind_of, read, wire_name
from iort_agent.files.folder import STATE, Folder, Uploads
from iort_agent.files.upload import ByteRate, GaveWayError, Outcome, Sender, make_uploader, trusting
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.recorder.config import RecorderConfig
from iort_agent.runtime import Runtime
from iort_agent.sources.sim import SimConfig
from iort_agent.spool import REJECT_NEW
from iort_agent.status import SOCKET, StatusServer
from iort_agent.verbs.upload import upload_files
from iort_contract.limits import SCHEMA_VERSION
from iort_contract.messages.batch import decode_batch
from iort_contract.messages.files import (
    PART_BYTES,
    Address,
    decode_file_request,
    encode_file_answer,
    file_key,
)
from iort_contract.messages.recorder import UPLOADED, Take, Trigger, Wanted
from iort_contract.topics import ACCEPTED, FILE, PING, build_topic
from testkit.agent import Loopback, ManualClock, MemorySpool, link_of
from testkit.waiting import GUARD_S
from tests.store_standin import store
from tests.unit.agent.recorder import rig as recorder_rig
from tests.unit.agent.recorder.rig import S
from tests.unit.agent.recorder.test_recorder import Bench
from tests.unit.agent.test_agent import config_file


class Rig:
    """A device whose loopback uplink ends at the store."""

    def __init__(self, there, certificate, uplink, clock):
        self.store, self.certificate, self.uplink, self.clock = there, certificate, uplink, clock
        self.stop = threading.Event()
        self.uploader = self.make()

    def make(self):
        return make_uploader(
            link_of(self.uplink, self.clock, robot="car"),
            root_ca=self.certificate,
            rate_kb_s=0,
        )

    def upload(self, path):
        return self.uploader.upload(
            read(path.parent, path.relative_to(path.parent), stop=self.stop), self.stop
        )

    def folder(self, path, *, settle_s=10.0, remove_after_s=None):
        watched = Folder(path, clock=self.clock, settle_s=settle_s, remove_after_s=remove_after_s)
        return Uploads(folders=[watched], uploader=self.uploader, clock=self.clock)


class WaitingClock(ManualClock):
    """Time passes only when all sent messages are answered."""

    def __init__(self, dispatcher):
        super().__init__()
        self._dispatcher = dispatcher

    def wait(self, event, seconds):
        # A request, its answer and its effect are consecutive calls.
        for _ in range(4):
            called = threading.Event()
            self._dispatcher.post(called.set)
            assert called.wait(GUARD_S)
        return super().wait(event, seconds)


@pytest.fixture
def rig(tmp_path):
    dispatcher = Dispatcher()
    clock = WaitingClock(dispatcher)
    uplink = Loopback(clock, dispatcher)
    folder = tmp_path / "tls"
    folder.mkdir()
    with store(uplink, folder) as (there, certificate):
        made = Rig(there, certificate, uplink, clock)
        uplink.start()
        while not made.uploader.ready():
            made.stop.wait(0.01)
        yield made
        uplink.stop(5)


@pytest.fixture
def large(tmp_path):
    path = tmp_path / "large.bag"
    path.write_bytes(os.urandom(2 * PART_BYTES + 1000))
    return path


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "notes.txt"
    path.write_bytes(b"driven well")
    return path


# --- names and hashes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 1, PART_BYTES - 1, PART_BYTES, PART_BYTES + 1, 2 * PART_BYTES])
def test_a_file_is_hashed_whole_and_by_part(tmp_path, size):
    content = os.urandom(size)
    path = tmp_path / "f.bag"
    path.write_bytes(content)
    local = read(tmp_path, path.relative_to(tmp_path), stop=threading.Event())
    assert (local.file.size, local.file.sha256) == (size, hashlib.sha256(content).hexdigest())
    pieces = [content[i : i + PART_BYTES] for i in range(0, max(1, size), PART_BYTES)]
    assert list(local.parts) == [hashlib.sha256(piece).hexdigest() for piece in pieces]
    assert local.file.parts == len(local.parts)
    assert file_key("car", local.file).endswith("/f.bag")


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("drive.bag", "drive.bag"),
        ("rosbag2_1/metadata.yaml", "rosbag2_1/metadata.yaml"),
        ("Fahrt über Mittag (2).bag", "Fahrt__ber_Mittag__2_.bag"),
        ("_hidden", "x_hidden"),
        ("a/b/c/d/e.txt", "a/b/c/d_e.txt"),
        ("x" * 150 + ".bag", "x" * 96 + ".bag"),
    ],
)
def test_each_name_becomes_an_allowed_name(path, name):
    assert wire_name(PurePath(path)) == name
    assert kind_of(PurePath("a.MCAP")) == ("recording", "application/x-mcap")


# --- one file ---------------------------------------------------------------------------------------


def test_small_and_large_files_arrive(rig, small, large):
    for path in (small, large):
        assert rig.store.objects[rig.upload(path)] == path.read_bytes()
    assert rig.store.puts == [1, 1, 2, 3]
    assert rig.uploader.sent_bytes == small.stat().st_size + large.stat().st_size
    # Uploading it again costs one request.
    rig.upload(large)
    assert rig.store.puts == [1, 1, 2, 3]


@pytest.mark.parametrize("fault", ["reset", "mute", 500, 503, 403, 404, 412])
def test_only_a_failed_part_is_sent_again(rig, large, fault):
    first = rig.store.put

    def put(part, content):
        status = first(part, content)
        if part == 1:
            rig.store.faults = [fault]
        return status

    rig.store.put = put
    assert rig.store.objects[rig.upload(large)] == large.read_bytes()
    assert rig.store.puts == [1, 2, 2, 3]


def test_only_missing_parts_are_sent_after_a_break(rig, large):
    rig.store.put, put = lambda part, content: rig.stop.set() or put(part, content), rig.store.put
    with pytest.raises(UploadError, match="stopped"):
        rig.upload(large)
    rig.store.put = put
    assert list(rig.store.parts) == [1]
    rig.stop.clear()
    # A new process knows only the file.
    rig.uploader = rig.make()
    assert rig.store.objects[rig.upload(large)] == large.read_bytes()
    assert rig.store.puts == [1, 2, 3]


def test_a_lost_answer_is_requested_again(rig, small):
    rig.store.silent = 2
    assert rig.store.objects[rig.upload(small)] == b"driven well"
    assert len(rig.store.requests) == 4
    assert len({request.id for request in rig.store.requests}) == 4


def test_a_rejection_by_the_cloud_is_raised_with_its_reason(rig, small):
    rig.store.refusals = [("no more than 5 bytes a day", 3600)]
    with pytest.raises(UploadError, match=r"notes.txt: refused: no more than 5 bytes a day") as caught:
        rig.upload(small)
    assert caught.value.again_s == 3600


def test_a_file_waits_after_several_failures(rig, small):
    rig.store.faults = [500] * 100
    with pytest.raises(UploadError, match="the server says 500") as caught:
        rig.upload(small)
    assert caught.value.again_s == 300
    assert len(rig.store.puts) == 6


def test_a_file_that_changes_during_its_upload_is_not_mixed(rig, large):
    local = read(large.parent, large.relative_to(large.parent), stop=rig.stop)
    with large.open("r+b") as file:
        file.write(b"changed")
    with pytest.raises(UploadError, match="changed during its upload") as caught:
        rig.uploader.upload(local, rig.stop)
    assert caught.value.again_s is not None
    assert rig.store.puts == []
    # Same size and time, other content: S3's checksum shows it.
    os.utime(large, ns=(local.look.mtime_ns, local.look.mtime_ns))
    with pytest.raises(UploadError, match="changed during its upload"):
        rig.uploader.upload(local, rig.stop)
    assert not rig.store.objects


def test_nothing_is_sent_unencrypted_or_to_an_untrusted_server(rig, small):
    sender = Sender(trust=trusting(None), rate=ByteRate(rig.clock, 0))
    local = read(small.parent, small.relative_to(small.parent), stop=rig.stop)
    url = rig.store._url
    address = Address(1, f"{url}/1", {"content-length": "11"})
    put = sender.put(address, local, 0, 11, rig.stop)
    assert put.outcome is Outcome.FAILED
    assert "CERTIFICATE_VERIFY_FAILED" in put.text
    with pytest.raises(UploadError, match="must be https"):
        sender.put(replace(address, url=url.replace("https", "http")), local, 0, 11, rig.stop)
    assert rig.store.puts == []


@pytest.mark.parametrize(
    ("url", "headers"),
    [
        ("https://localhost:99999/1", {}),
        ("https://[::1/1", {}),
        ("https://localhost:x/1", {}),
        (f"https://{'a' * 64}.example/1", {}),
        ("https:///1", {}),
        ("HOST/1", {"x-amz-meta": "a\r\nhost: other"}),
    ],
)
def test_an_unusable_address_is_an_upload_error(rig, small, url, headers):
    sender = Sender(trust=trusting(rig.certificate), rate=ByteRate(rig.clock, 0))
    local = read(small.parent, small.relative_to(small.parent), stop=rig.stop)
    address = Address(1, url.replace("HOST", rig.store._url), headers)
    with pytest.raises(UploadError, match="the cloud's address"):
        sender.put(address, local, 0, 11, rig.stop)


@pytest.mark.parametrize(
    "odd",
    [
        '"have": [[1, 1e999]]',
        '"have": [[1, 5], [5, 9]]',
        '"have": [[9, 9], [1, 1]]',
        '"addresses": [{"part": 1e999, "url": "https://localhost/1", "headers": {}}]',
        '"refused": "no", "again_s": 1e999',
    ],
)
def test_a_malformed_answer_is_logged_and_the_next_one_used(rig, small, odd, caplog):
    answer, faults = rig.store._answer, [odd]

    def on_request(message):
        request = decode_file_request(message.payload)
        if faults:
            said = f'{{"v": {SCHEMA_VERSION}, "id": "{request.id}", "key": "k", "stored": false, '
            rig.uplink.deliver(rig.store._answers, (said + faults.pop() + "}").encode())
        else:
            rig.uplink.deliver(rig.store._answers, encode_file_answer(answer(request)))

    rig.uplink.subscribe(build_topic(PING, "car", FILE), on_request)
    assert rig.store.objects[rig.upload(small)] == b"driven well"
    assert "pong/iort/car/file cannot be read" in caplog.text


def test_the_rate_is_limited(tmp_path):
    clock, stop = ManualClock(), threading.Event()
    rate, began = ByteRate(clock, 1000), clock.monotonic()
    for _ in range(11):
        rate.spend(500, stop)
    assert clock.monotonic() - began == pytest.approx(5.0)


# --- a folder ---------------------------------------------------------------------------------------


@pytest.fixture
def bags(tmp_path):
    folder = tmp_path / "bags"
    folder.mkdir()
    return folder


def test_only_finished_files_are_uploaded(rig, bags):
    growing, link = bags / "a.bag", bags / "link.bag"
    growing.write_bytes(b"1")
    (bags / "b.bag.active").write_bytes(b"1")
    (bags / ".hidden").write_bytes(b"1")
    link.symlink_to(growing)
    uploads = rig.folder(bags)
    assert not uploads.step(rig.stop)
    assert uploads.status().waiting == 1
    rig.clock.advance(9)
    growing.write_bytes(b"12")
    assert not uploads.step(rig.stop)
    rig.clock.advance(9)
    assert not uploads.step(rig.stop)
    rig.clock.advance(2)
    assert uploads.step(rig.stop)
    assert list(rig.store.objects.values()) == [b"12"]
    assert not uploads.step(rig.stop)
    assert uploads.status() == Files(0, 1, 2, current=None, current_bytes=0, last_error=None)


def test_a_new_process_does_not_upload_again(rig, bags):
    (bags / "drive").mkdir()
    (bags / "drive" / "large.db3").write_bytes(os.urandom(PART_BYTES + 1))
    (bags / "old.bag").write_bytes(b"old")
    os.utime(bags / "old.bag", (1, 1))
    uploads = rig.folder(bags, settle_s=0)
    assert uploads.step(rig.stop)
    # The process ends during the second file.
    rig.store.put, put = lambda part, content: rig.stop.set() or put(part, content), rig.store.put
    uploads.step(rig.stop)
    rig.store.put = put
    assert list(rig.store.parts) == [1]
    rig.stop.clear()
    again = rig.folder(bags, settle_s=0)
    assert again.step(rig.stop)
    assert not again.step(rig.stop)
    assert rig.store.puts == [1, 1, 2]
    assert [key.rsplit("/", 2)[-2:] for key in rig.store.objects][1] == ["drive", "large.db3"]


@pytest.mark.parametrize(
    "damage",
    [b"", b"{", b"[]", b"7", b"\xff", pytest.param(b"[" * 100_000, id="deep"), b'["a.bag", 1, Infinity, 1]'],
)
def test_files_are_read_again_after_a_damaged_state(rig, bags, damage):
    (bags / "a.bag").write_bytes(b"1")
    assert rig.folder(bags, settle_s=0).step(rig.stop)
    (bags / STATE).write_bytes(damage)
    assert rig.folder(bags, settle_s=0).step(rig.stop)
    assert rig.store.puts == [1]


def test_an_uploaded_file_is_removed_when_it_is_due(rig, bags):
    path = bags / "a.bag"
    path.write_bytes(b"1")
    uploads = rig.folder(bags, settle_s=0, remove_after_s=3600)
    assert uploads.step(rig.stop)
    rig.clock.advance(3599)
    uploads.step(rig.stop)
    assert path.exists()
    rig.clock.advance(2)
    uploads.step(rig.stop)
    assert not path.exists()


def test_a_file_that_changed_after_its_upload_is_uploaded_again(rig, bags):
    path = bags / "a.bag"
    path.write_bytes(b"1")
    uploads = rig.folder(bags, settle_s=0, remove_after_s=3600)
    assert uploads.step(rig.stop)
    path.write_bytes(b"12")
    rig.clock.advance(4000)
    assert uploads.step(rig.stop)
    assert path.exists()
    assert sorted(rig.store.objects.values()) == [b"1", b"12"]


def test_a_rejected_file_does_not_delay_others(rig, bags):
    for name, age in (("first.bag", 100), ("second.bag", 200)):
        (bags / name).write_bytes(name.encode())
        os.utime(bags / name, (age, age))
    uploads = rig.folder(bags, settle_s=0)
    rig.store.refusals = [("not today", 60)]
    assert uploads.step(rig.stop)
    assert "first.bag: refused: not today" in (uploads.status().last_error or "")
    assert uploads.step(rig.stop)
    assert list(rig.store.objects.values()) == [b"second.bag"]
    assert not uploads.step(rig.stop)
    assert uploads.status().waiting == 1
    rig.clock.advance(61)
    assert uploads.step(rig.stop)
    assert b"first.bag" in rig.store.objects.values()


def test_a_file_rejected_repeatedly_waits_longer_each_time(rig, bags):
    (bags / "a.bag").write_bytes(b"1")
    uploads = rig.folder(bags, settle_s=0)
    rig.store.refusals = [("again at once", 0)] * 10_000
    tried_s = []
    for second in range(1000):
        if uploads.step(rig.stop):
            tried_s.append(second)
            assert not uploads.step(rig.stop)
        rig.clock.advance(1)
    assert tried_s == [0, 5, 15, 35, 75, 155, 315, 615, 915]
    # A changed file counts as a new one.
    (bags / "a.bag").write_bytes(b"12")
    assert uploads.step(rig.stop)
    rig.clock.advance(5)
    assert uploads.step(rig.stop)


def test_a_file_with_an_unexpected_error_does_not_delay_others(rig, bags):
    for name, age in (("first.bag", 100), ("second.bag", 200)):
        (bags / name).write_bytes(name.encode())
        os.utime(bags / name, (age, age))
    uploads = rig.folder(bags, settle_s=0)
    upload = rig.uploader.upload

    def odd(local, *rest):
        if local.path.name == "first.bag":
            raise RuntimeError("odd")
        return upload(local, *rest)

    rig.uploader.upload = odd
    with pytest.raises(RuntimeError):
        uploads.step(rig.stop)
    assert uploads.step(rig.stop)
    assert list(rig.store.objects.values()) == [b"second.bag"]


def test_the_command_gives_advice_while_an_agent_runs(tmp_path, bags):
    file = config_file(tmp_path, "{type: sim, stream: vesc, rate_hz: 1}", f"files: {{folder: {bags}}}")
    server = StatusServer(tmp_path / SOCKET, lambda: {"pid": 7})
    server.start()
    try:
        with pytest.raises(UploadError, match=rf"process 7.*copy the files into {bags}"):
            list(upload_files(load_config(file), [file], status_socket=tmp_path / SOCKET))
    finally:
        server.stop()


# --- what gives way to others -----------------------------------------------------------------------


def test_a_file_gives_way_after_a_part_and_goes_on_with_the_next(rig, large):
    local = read(large.parent, PurePath(large.name), stop=rig.stop)
    for _ in range(2):
        with pytest.raises(GaveWayError):
            rig.uploader.upload(local, rig.stop, gives_way=lambda: True)
    assert rig.uploader.upload(local, rig.stop, gives_way=lambda: True) == file_key("car", local.file)
    assert rig.store.puts == [1, 2, 3]


class Courier:
    """An uploader that notes what it is given, and gives way when it may."""

    def __init__(self):
        self.names = []
        self.meanwhile = lambda: None
        self.sent_bytes = 0

    def upload(self, local, _stop, _progress, gives_way):
        self.names.append(local.name.name)
        self.meanwhile()
        if gives_way():
            raise GaveWayError("gives way", again_s=0)
        return f"robots/car/{local.name}"


def test_incidents_are_uploaded_last_and_told(rig, tmp_path):
    courier, told = Courier(), []
    first, last = tmp_path / "first", tmp_path / "last"
    for path in (first, last):
        path.mkdir()
    (last / "incident.mcap").write_bytes(b"1")
    folders = [
        Folder(first, clock=rig.clock, settle_s=0, remove_after_s=None),
        Folder(
            last,
            clock=rig.clock,
            settle_s=0,
            remove_after_s=0,
            on_uploaded=lambda name, key: told.append((name, key, (last / name).exists())),
        ),
    ]
    uploads = Uploads(folders=folders, uploader=courier, clock=rig.clock)
    courier.meanwhile = lambda: (first / "image.jpg").write_bytes(b"2")
    assert uploads.step(rig.stop)
    assert told == []
    courier.meanwhile = lambda: None
    assert uploads.step(rig.stop)
    assert uploads.step(rig.stop)
    assert courier.names == ["incident.mcap", "image.jpg", "incident.mcap"]
    assert told == [(PurePath("incident.mcap"), "robots/car/incident.mcap", True)]
    assert list(last.glob("*.mcap")) == []
    assert uploads.status().last_error is None


def test_an_incident_reaches_the_bucket_after_a_refusal_and_a_restart(rig, tmp_path):
    recorder = recorder_rig.Rig(tmp_path / "ring", triggers={"hardbrake": recorder_rig.BRAKE})
    recorder.pass_s(6)
    recorder.brake()
    recorder.pass_s(5)
    recorder.cut()
    (path,) = recorder.files.glob("*.mcap")
    content = path.read_bytes()

    def folder(of):
        return Folder(
            of.files,
            clock=rig.clock,
            settle_s=0,
            remove_after_s=0,
            on_uploaded=of.incidents.uploaded,
        )

    rig.store.refusals = [("quota", 60)]
    uploads = Uploads(folders=[folder(recorder)], uploader=rig.uploader, clock=rig.clock)
    assert uploads.step(rig.stop)
    recorder = recorder.again()
    uploads = Uploads(folders=[folder(recorder)], uploader=rig.uploader, clock=rig.clock)
    assert uploads.step(rig.stop)
    recorder.settle()
    assert rig.store.objects == {recorder.told[-1].key: content}
    assert recorder.states() == ["kept", "uploaded"]
    assert recorder.plan.incidents == {}
    assert list(recorder.files.glob("*.mcap")) == []


def left_by_a_killed_agent(ring):
    """A ring with an open incident of messages that were written; the messages."""
    began_us = SystemClock().now_us() - 60 * S
    bench = Bench(ring, now_us=began_us)
    bench.want(takes=(Take("a" * 16, began_us, began_us + 20 * S, "anna", "look"),))
    emit = bench.recorder.around(lambda *_, **__: 0.0)
    for i in range(50):
        emit("imu", bench.clock.now_us(), {"x": i})
        bench.clock.advance(0.2)
        bench.recorder.ring.work()
    bench.recorder.ring.work(ending=True)
    bench.recorder.ring._folder.close()
    return [f'{{"x":{i}}}'.encode() for i in range(50)]


class Flushed:
    """A run without sources, and with a store if it shall reach one."""

    def __init__(self, tmp_path, ring):
        self.clock = SystemClock()
        self.uplink = Loopback(self.clock, Dispatcher())
        config = Config("car", "host", Path(), Path(), (SimConfig(),), recorder=RecorderConfig(folder=ring))
        self.config = without_sources(config)
        self.folder = tmp_path / "tls"
        self.folder.mkdir(exist_ok=True)

    def run(self, *, drain_s=None, certificate=None):
        self.agent = Agent(
            replace(self.config, root_ca=certificate),
            uplink=self.uplink,
            spool=MemorySpool(max_bytes=10**9, policy=REJECT_NEW),
            clock=self.clock,
        )
        return Runtime(self.agent, stopped_s=0.0, progress_s=0.0).run(drain_s=drain_s)


def test_flush_uploads_the_incidents_that_earlier_runs_left(tmp_path):
    ring = tmp_path / "ring"
    sent = left_by_a_killed_agent(ring)
    flushed = Flushed(tmp_path, ring)
    with store(flushed.uplink, flushed.folder) as (there, certificate):
        assert flushed.run(certificate=certificate) == 0
    ((_, content),) = there.objects.items()
    messages = [message.data for _, _, message in make_reader(io.BytesIO(content)).iter_messages()]
    assert messages == sent
    states = [
        batch.columns["state"]
        for message in flushed.uplink.published
        if message.topic.startswith("$aws") and message.topic.endswith("/incidents")
        for batch in [decode_batch(message.payload)]
    ]
    assert states[-1][-1] == UPLOADED
    assert list((ring / "incidents").glob("*.mcap")) == []


def test_flush_says_what_it_leaves_of_incidents(tmp_path, caplog):
    left_by_a_killed_agent(tmp_path / "ring")
    flushed = Flushed(tmp_path, tmp_path / "ring")
    assert flushed.run(drain_s=0.5) == 1
    assert "0 incidents are still to be cut, and 1 to be uploaded" in caplog.text or (
        "1 incidents are still to be cut, and 0 to be uploaded" in caplog.text
    )


def test_flush_fires_no_trigger_and_does_no_take(tmp_path):
    bench = Bench(tmp_path / "ring")
    bench.want(Trigger("stopped", on="stop", cooldown_s=0))
    bench.recorder.close()
    flushed = Flushed(tmp_path, tmp_path / "ring")
    assert flushed.run(drain_s=1) == 0
    recorder = flushed.agent.recorder
    for stopped in (False, True):
        recorder.stopped(stopped)
    recorder.want(Wanted({}, {"b" * 16: {"from_us": 1, "to_us": 2}}))
    recorder.step()
    recorder.step_slowly()
    assert recorder.incidents.counts["edges"] == 0
    assert recorder.answers == {"stopped": ACCEPTED}, "as the next run will answer"
