"""The whole agent over an uplink in memory, and the command around it."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Callable, Sequence
from unittest.mock import Mock

import pytest

from iort_agent.agent import Agent, make_status
from iort_agent.cli import main
from iort_agent.common.schema import Place, load
from iort_agent.common.state import Connection, Status, read
from iort_agent.common.threads import Clock, SystemClock
from iort_agent.config import Config, without_sources
from iort_agent.control.config import DownlinkConfig
from iort_agent.errors import SourceError
from iort_agent.lanes import PingConfig, RecordConfig
from iort_agent.metrics import MetricsConfig
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.mqtt.uplink import matches
from iort_agent.runtime import Runtime
from iort_agent.sources import Emit, SourceConfig
from iort_agent.sources.recording import BagConfig
from iort_agent.sources.sim import SimConfig
from iort_agent.spool import REJECT_NEW, QueueConfig, Spool
from iort_agent.spool.sqlite import make_spool
from iort_agent.video import Frame
from iort_agent.video.config import video_rule
from iort_contract.catalog.streams import AGENT_FIELDS, TYPES_STREAM
from iort_contract.limits import MAX_FIELDS
from iort_contract.messages.account import lost
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.messages.commands import DRIVE_TYPE, Command, encode_command
from iort_contract.messages.video import VideoTerms
from iort_contract.ros.message import MessageType, message_type
from iort_contract.topics import SHADOW
from testkit.agent import Loopback, MemorySpool, Published
from testkit.waiting import GUARD_S

T0 = 1_700_000_000_000_000
RECORD = "$aws/rules/iort_record/dt/iort/car1"


DOWNLINK = {
    "cmd": {"drive": {"topic": "/drive", "type": DRIVE_TYPE, "partial": True, "motion": {"stop": {}}}},
    "drive": {},
}


class Script(SourceConfig):
    """A source that runs a function."""

    def __init__(self, run: Any, *streams: str) -> None:
        self.run, self._streams = run, streams or ("vesc",)

    def streams(self) -> Sequence[str]:
        return self._streams

    def describe(self) -> str:
        return "script"

    def build(self, clock: Clock) -> Script:
        return self

    def recorded(self) -> bool:
        return True

    def report(self) -> dict[str, Any]:
        return {"played": True}


def drive(emit: Emit, stop: threading.Event) -> None:
    for i in range(500):
        emit("vesc", T0 + i * 20_000, {"speed": i})


class Watched(Loopback):
    """A broker in memory that acts when somebody looks at its connection for the third time."""

    def __init__(self, clock: Clock, act: Callable[[], object]) -> None:
        super().__init__(clock, Dispatcher(), connected=False)
        self._act, self._looks = act, 0

    def status(self) -> Connection:
        self._looks += 1
        if self._looks == 3:
            self._act()
        return super().status()


class Rig:
    def __init__(
        self,
        *sources: Any,
        connected: bool = True,
        at_end: tuple[Path, Callable[[Rig], object]] | None = None,
        **settings: Any,
    ) -> None:
        config = Config("car1", "host", Path(), Path(), tuple(Script(run) for run in sources))  # type: ignore[misc]  # a part of a source
        self.clock = SystemClock()
        self.dispatcher = Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher, connected=connected)
        self.spool: Spool = MemorySpool(max_bytes=settings.pop("max_bytes", 10**9), policy=REJECT_NEW)
        if at_end is not None:
            # A queue on disk, no connection, and what is done when the run waits at its end.
            queue, act = at_end
            self.uplink = Watched(self.clock, lambda: act(self))
            self.spool = make_spool(QueueConfig(queue), self.clock)
            config = config if sources else without_sources(config)
        self.agent = Agent(
            replace(config, **settings), uplink=self.uplink, spool=self.spool, clock=self.clock
        )
        self.runtime = Runtime(self.agent, stopped_s=0.0, progress_s=0.0)

    def status(self) -> dict[str, Any]:
        """The document of the status socket."""
        return asdict(make_status(self.agent))

    def recorded(self, stream: str = "vesc") -> list[Any]:
        self.seqs = [batch.seq for batch in self.batches(stream)]
        return [value for batch in self.batches(stream) for value in batch.columns["speed"]]

    def batches(self, stream: str) -> list[Batch]:
        """What the broker has got of a stream."""
        return [decode_batch(m.payload) for m in self.uplink.published if m.topic == f"{RECORD}/{stream}"]


def test_an_emergency_stop_outlives_the_agent_also_without_a_connection(tmp_path: Path) -> None:
    downlink = load(DownlinkConfig, DOWNLINK, Place(tmp_path))
    settings: dict[str, Any] = {
        "sources": (SimConfig(),),
        "downlink": downlink,
        "queue": QueueConfig(tmp_path / "queue.db"),
    }

    def run() -> Agent:
        return Rig(connected=False, **settings).agent

    first = run()
    first.apply(replace(first.shadow.settings, motion_stopped=True))
    second = run()
    assert second.shadow.settings.motion_stopped
    assert "emergency stop: no motion until an operator releases it" in make_status(second).alarms
    second.apply(replace(second.shadow.settings, motion_stopped=False))
    assert not run().shadow.settings.motion_stopped


def test_a_robot_with_a_camera_is_driven_by_the_pictures_that_it_has_numbered(tmp_path: Path) -> None:
    config, place = {"source": {"type": "sim"}, "max_age_ms": 5000}, Place(tmp_path)
    rig = Rig(
        sources=(SimConfig(),),
        downlink=load(DownlinkConfig, DOWNLINK, place),
        video=video_rule()(config, place),
    )
    agent, clock = rig.agent, rig.clock
    now, now_us = clock.monotonic(), clock.now_us()
    agent.offset.add(now, now, now_us // 1000)
    rig.uplink.connect()
    shadow = {"state": {}, "version": 1}
    rig.uplink.deliver(f"$aws/things/car1/shadow/name/{SHADOW}/get/accepted", json.dumps(shadow).encode())
    picture: Any = None
    agent.pictures.add(Frame(7, now_us, now, picture))
    seen: list[dict[str, Any]] = [{}, {"frame": 8}, {"frame": 7}, {"blind": True}]
    for seq, named in enumerate(seen):
        command = Command("feedbeef", now_us, seq, now_us, 60_000, {}, 10_000, answer=True, **named)
        rig.uplink.deliver("cmd/iort/car1/drive", encode_command(command))
        rig.dispatcher.run_pending()
        agent.shadow.tick()
    reports = [json.loads(m.payload) for m in rig.uplink.published if m.topic.endswith("/update")]
    reported = [report["state"]["reported"] for report in reports]
    outcomes = [one["commands"]["drive"]["outcome"].partition(",")[0] for one in reported]
    assert outcomes == ["no picture", "picture late", "accepted", "accepted"]
    assert reported[0]["video"] == vars(VideoTerms(640, 480, 15.0, 5000))


def test_every_sample_is_recorded_and_the_report_says_so() -> None:
    rig = Rig(drive)
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.recorded() == list(range(500))
    assert rig.seqs == list(range(10))
    report = rig.status()
    counts = {"samples": 500, "stored": 500, "batches": 10, "refused": 0, "nulled": 0}
    assert counts.items() <= report["streams"]["vesc"].items()
    assert report["spool"]["batches"] == report["spool"]["dropped_batches"] == 0
    assert report["boot"] == decode_batch(rig.uplink.published[-1].payload).boot
    live = [m for m in rig.uplink.published if m.topic == "live/iort/car1/vesc"]
    assert report["lanes"]["live"]["published"] == len(live) > 0
    assert rig.uplink.stopped


def test_a_status_is_the_same_after_reading_its_json() -> None:
    rig = Rig(drive, ping=PingConfig(rate_hz=20, paths=("broker",)))
    assert rig.runtime.run(drain_s=10) == 0
    status = make_status(rig.agent)
    assert (status.streams["vesc"].samples, status.lanes.ping.rate_hz) == (500, 20)
    written = json.loads(json.dumps({**asdict(status), "of a later version": 1}))
    written["over_share"] = {"since_ms": 1, "last_ms": 2, "batches": 3}
    written["clock"] = {"offset_ms": 1.5, "uncertainty_ms": 0.5}
    written["troubles"] = [{"at_s": 1.0, "level": "error", "text": "x"}]
    assert asdict(read(Status, written)) == {k: v for k, v in written.items() if k != "of a later version"}
    del written["connection"]["connects"]
    with pytest.raises(KeyError, match="connects"):
        read(Status, written)


@pytest.mark.parametrize("asked", [True, False])
def test_an_emergency_stop_ends_with_an_agent_that_is_asked_to_end(asked: bool) -> None:
    def end(_emit: Emit, _stop: threading.Event) -> None:
        if asked:
            rig.runtime.stop()

    rig = Rig(end)
    downlink = rig.agent.downlink = Mock(report=dict, alarms=list, waits=lambda: None)
    rig.runtime.run(drain_s=10)
    downlink.halt.assert_called_once_with(keep_stop=not asked)
    downlink.close.assert_called_once_with(keep_stop=not asked)


def test_stop_ends_the_run_in_good_order() -> None:
    def endless(emit: Emit, stop: threading.Event) -> None:
        drive(emit, stop)
        rig.runtime.stop()
        assert stop.wait(GUARD_S)

    rig = Rig(endless)
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.recorded() == list(range(500))


def test_undelivered_samples_are_reported(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig(drive, connected=False)
    assert rig.runtime.run(drain_s=0.05) == 1
    # Two of them are the agent's accounts, of its start and its end.
    assert "502 samples in 12 batches were not delivered and are lost" in caplog.text
    assert rig.status()["spool"]["samples"] == 502


def test_a_recording_is_done_when_it_is_delivered_however_long_that_takes(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    rig = Rig(drive, at_end=(tmp_path / "queue.db", lambda rig: rig.uplink.connect()))
    assert rig.runtime.run(drain_s=None) == 0
    assert rig.recorded() == list(range(500))
    assert "502 samples in 12 batches are still to be delivered; not connected: no answer" in caplog.text
    rig.spool.close()


def test_what_a_recording_leaves_is_flushed_and_not_played_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    queue = tmp_path / "queue.db"
    played = Rig(drive, at_end=(queue, lambda rig: rig.runtime.stop()))
    assert played.runtime.run(drain_s=None) == 1
    assert "502 samples in 12 batches were not delivered; they are in the queue: `iort-agent flush`" in (
        caplog.text
    )
    played.spool.close()
    flushed = Rig(at_end=(queue, lambda rig: rig.uplink.connect()))
    assert flushed.runtime.run(drain_s=None) == 0
    assert flushed.recorded() == list(range(500))
    assert flushed.spool.backlog().batches == 0
    flushed.spool.close()


def test_a_stopped_run_leaves_the_rest_to_the_next_one(tmp_path: Path) -> None:
    def stopped(emit: Emit, stop: threading.Event) -> None:
        drive(emit, stop)
        rig.runtime.stop()

    rig = Rig(stopped, at_end=(tmp_path / "queue.db", lambda _: None))
    assert rig.runtime.run(drain_s=None) == 0
    assert rig.spool.backlog().samples == 502
    rig.spool.close()


def test_a_backlog_is_delivered_after_a_late_connect() -> None:
    def late(emit: Emit, stop: threading.Event) -> None:
        drive(emit, stop)
        rig.uplink.connect()

    rig = Rig(late, connected=False)
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.recorded() == list(range(500))


def test_dropped_samples_are_not_a_success(caplog: pytest.LogCaptureFixture) -> None:
    def late(emit: Emit, stop: threading.Event) -> None:
        # More seconds than may be open at once, so that some close before the connection.
        for i in range(1500):
            emit("vesc", T0 + i * 20_000, {"speed": i})
        rig.uplink.connect()

    rig = Rig(late, connected=False, max_bytes=1000)
    assert rig.runtime.run(drain_s=10) == 1
    assert "were dropped: the queue was full" in caplog.text
    report = rig.status()
    assert 0 < len(rig.recorded()) < 1500
    assert rig.seqs == sorted(set(rig.seqs)), "the numbers of those dropped are missing"
    assert len(rig.seqs) < report["streams"]["vesc"]["batches"] == 30
    delivered = [decode_batch(m.payload) for m in rig.uplink.published if "/dt/" in m.topic]
    stored = sum(stream["stored"] for stream in report["streams"].values())
    assert sum(len(batch.times_us) for batch in delivered) == stored - report["spool"]["dropped_samples"]


@pytest.mark.parametrize(
    ("error", "text"), [(SourceError("no such bag"), "no such bag"), (ZeroDivisionError(), "Traceback")]
)
def test_a_failed_source_does_not_end_the_others(
    error: Exception, text: str, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(emit: Emit, stop: threading.Event) -> None:
        raise error

    rig = Rig(broken, drive)
    assert rig.runtime.run(drain_s=10) == 1
    assert rig.recorded() == list(range(500))
    assert rig.status()["failed_sources"] == ["script"]
    assert text in caplog.text


def give_nothing(emit: Emit, stop: threading.Event) -> None:
    pass


def give_too_wide(emit: Emit, stop: threading.Event) -> None:
    for i in range(3):
        emit("vesc", T0 + i, dict.fromkeys((f"x{i}" for i in range(MAX_FIELDS + 1)), 1.0))


@pytest.mark.parametrize(
    ("run", "why"),
    [(give_nothing, "it gave no sample"), (give_too_wide, "none of its 3 samples could be stored")],
)
def test_a_source_that_ends_with_nothing_stored_has_failed(
    run: Any, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig(run)
    assert rig.runtime.run(drain_s=10) == 1
    assert rig.status()["failed_sources"] == ["script"]
    assert f"source failed: script: {why}" in caplog.text


def test_one_refused_sample_is_not_a_failure() -> None:
    def both(emit: Emit, stop: threading.Event) -> None:
        give_too_wide(emit, stop)
        drive(emit, stop)

    rig = Rig(both)
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.status()["streams"]["vesc"]["refused"] == 3


def test_a_source_that_was_stopped_before_its_first_sample_has_not_failed() -> None:
    def wait(emit: Emit, stop: threading.Event) -> None:
        rig.runtime.stop()
        assert stop.wait(GUARD_S)

    rig = Rig(wait)
    assert rig.runtime.run(drain_s=10) == 0


def test_round_trips_are_recorded_like_any_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    enough = threading.Event()

    def wait_for_pings(emit: Emit, stop: threading.Event) -> None:
        emit("vesc", T0, {"speed": 1})
        assert enough.wait(GUARD_S)

    rig = Rig(wait_for_pings, ping=PingConfig(rate_hz=20, paths=("broker",)))
    seen: list[Published] = []

    def count(message: Published) -> None:
        seen.append(message)
        if sum(m.topic == "ping/iort/car1/broker" for m in seen) == 3:
            enough.set()

    rig.uplink.verdict = count
    monkeypatch.setattr("iort_agent.runtime._LAST_PONGS_S", GUARD_S)
    assert rig.runtime.run(drain_s=GUARD_S) == 0
    values = [value for batch in rig.batches("rtt") for value in batch.columns["broker_ms"]]
    ping = rig.status()["pings"]["broker"]
    assert len(values) == ping["received"] == ping["sent"] >= 3
    assert ping["lost"] == 0
    assert not [m for m in seen if m.topic == "live/iort/car1/rtt"]


def test_the_record_lane_can_be_switched_off() -> None:
    rig = Rig(drive, record=RecordConfig(enabled=False))
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.recorded() == []
    assert rig.status()["lanes"]["live"]["published"] > 0


def test_lanes_fields_and_rates_change_while_it_runs() -> None:
    def tuned(emit: Emit, stop: threading.Event) -> None:
        emit("vesc", T0, {"speed": 1, "voltage_input": 40})
        settings = rig.agent.streams.settings
        rig.agent.apply(replace(settings, fields={"vesc": ("speed", "gone")}))
        emit("vesc", T0 + 1_000_000, {"speed": 2, "voltage_input": 40})
        rig.agent.apply(replace(settings, record_enabled=False, live_enabled=False))
        live = rig.status()["lanes"]["live"]["published"]
        for i in range(100):
            emit("vesc", T0 + 2_000_000 + i, {"speed": 3, "voltage_input": 40})
        assert rig.status()["lanes"]["live"]["published"] <= live + 1
        rig.agent.apply(settings)
        emit("vesc", T0 + 3_000_000, {"speed": 4, "voltage_input": 40})

    rig = Rig(tuned)
    began = rig.clock.monotonic()
    assert rig.runtime.run(drain_s=2 * GUARD_S) == 0
    assert rig.clock.monotonic() - began < GUARD_S, "it waited for something that does not come"
    assert rig.recorded() == [1, 2, 4]
    assert [sorted(batch.columns) for batch in rig.batches("vesc")] == [
        ["speed", "voltage_input"], ["speed"], ["speed", "voltage_input"],
    ]  # fmt: skip


def test_types_are_repeated_when_recording_resumes() -> None:
    said = MessageType("vesc", "/vesc", "p/A", "0" * 32, "float64 speed\n")

    def late(emit: Emit, stop: threading.Event) -> None:
        emit(TYPES_STREAM, T0, said.sample())
        rig.agent.apply(replace(rig.agent.streams.settings, record_enabled=True))
        emit("vesc", T0 + 1_000_000, {"speed": 1})

    rig = Rig(late, record=RecordConfig(enabled=False))
    assert rig.runtime.run(drain_s=10) == 0
    assert rig.recorded() == [1]
    (batch,) = rig.batches("types")
    sample = {name: column[0] for name, column in batch.columns.items()}
    assert message_type(sample) == said


def test_the_agents_metrics_are_a_stream() -> None:
    seen = threading.Event()

    def wait(emit: Emit, stop: threading.Event) -> None:
        emit("vesc", T0, {"speed": 1})
        assert seen.wait(GUARD_S)

    rig = Rig(wait, metrics=MetricsConfig(every_s=0.1), record=RecordConfig(batch_s=0))
    rig.uplink.verdict = lambda message: seen.set() if message.topic == f"{RECORD}/agent" else None
    assert rig.runtime.run(drain_s=10) == 0
    assert list(rig.batches("agent")[0].columns) == list(AGENT_FIELDS)
    assert not [m for m in rig.uplink.published if m.topic == "live/iort/car1/agent"]


@pytest.mark.parametrize(
    ("topic_filter", "topic", "expected"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a/b/c", False),
        ("a/b/c", "a/b", False),
        ("a/+/c", "a/b/c", True),
        ("a/+", "a/b/c", False),
        ("a/#", "a/b/c", True),
        ("a/#", "b/b/c", False),
        ("+/+", "a/b", True),
    ],
)
def test_topic_filters(topic_filter: str, topic: str, expected: bool) -> None:
    assert matches(topic_filter, topic) is expected


def test_the_account_names_the_topic_of_a_recording_whose_messages_were_not_read(tmp_path: Path) -> None:
    from tests.unit.agent.sources.test_bag import STORAGES, described, write_ros2

    def change(topic: Any) -> None:
        topic["message_count"] += 2

    path = described(write_ros2(tmp_path / "drive", STORAGES[0]), change)
    rig = Rig(sources=(BagConfig(path=path, speed=0.0),))
    assert rig.runtime.run(drain_s=10) == 1
    texts = [
        text
        for batch in rig.batches("account")
        for text in batch.columns.get("counts", ())
        if isinstance(text, str)
    ]
    assert lost(json.loads(texts[-1])) == {"/sensors/core.unread": 2}


def config_file(folder: Path, source: str, more: str = "") -> Path:
    for name in ("cert.pem", "key.pem", "ca.pem"):
        (folder / name).write_text("not a certificate")
    file = folder / "car.yaml"
    file.write_text(
        "robot: car1\nendpoint: localhost\ncertificate: cert.pem\nprivate_key: key.pem\nroot_ca: ca.pem\n"
        f"sources: [{source}]\n{more}\n"
    )
    return file


def test_remappings_of_roslaunch_are_accepted(tmp_path: Path) -> None:
    config = str(config_file(tmp_path, "{type: sim}"))
    remappings = ["__name:=x", "__log:=/tmp/y.log", "/from:=/to", "~from:=to", "from:=/to", "_rate:=5"]
    assert main(["--config", config, *remappings, "--check-config"]) == 0
    for wrong in ("1from:=/to", "/a:=/b:=/c", "from:/to"):
        with pytest.raises(SystemExit):
            main(["--config", config, "--check-config", wrong])
    with pytest.raises(SystemExit):
        main(["status", "--config", config, "__name:=x"])


def test_a_wrong_configuration_prints_a_message_and_exits_with_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--config", str(config_file(tmp_path, "{type: sum}"))]) == 2
    error = capsys.readouterr().err
    assert error.startswith("iort-agent: ")
    assert "sources[0].type" in error
    assert "Traceback" not in error


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["--help"], 0, "Without COMMAND it runs"),
        ([], 2, "replace the robot's key and certificate"),
        (["rum"], 2, "(did you mean run?)"),
        (["run", "--config", "x", "--drain", "1", "--log-level", "inf"], 2, "(did you mean info?)"),
        (["run", "--config", "x", "--drian-s", "1"], 2, "--drian-s 1 (did you mean --drain-s?)"),
        (["--config", "x", "--drain-s", "-1"], 2, "must be 0 to 86400"),
        (["--config", "x", "--no"], 2, "unrecognized arguments: --no"),
    ],
)
def test_wrong_use_names_the_commands_or_the_argument(
    arguments: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as raised:
        main(arguments)
    assert raised.value.code == status
    printed = capsys.readouterr()
    assert said in (printed.err if status else printed.out)
