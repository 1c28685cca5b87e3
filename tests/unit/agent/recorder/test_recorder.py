"""The recorder as the agent runs it: a real ring, the shadow's words, events, and files that others open."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Iterator, Mapping

import pytest

from iort_agent.agent import Agent, make_status
from iort_agent.common.state import Connection
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config
from iort_agent.mqtt.dispatch import Dispatcher
from iort_agent.recorder.config import RecorderConfig
from iort_agent.recorder.recorder import DISCONNECT_S, Recorder
from iort_agent.runtime import Runtime
from iort_agent.sources import Emit
from iort_agent.status import render
from iort_contract.messages.recorder import (
    KEPT,
    UPLOADED,
    Incident,
    Take,
    Trigger,
    Wanted,
    encode_take,
    encode_trigger,
    incident,
)
from iort_contract.ros.message import RosMessage, RosType
from iort_contract.topics import ACCEPTED
from testkit.agent import Loopback, ManualClock, MemorySpool
from testkit.waiting import until
from tests.unit.agent.control.downlink_rig import FakeGraph
from tests.unit.agent.control.test_peers import string
from tests.unit.agent.recorder import killed
from tests.unit.agent.recorder.rig import BRAKE, T0, S
from tests.unit.agent.test_agent import Script

highlevel = pytest.importorskip("rosbags.highlevel")
reader = pytest.importorskip("mcap.reader")

TEXT = RosType("/chatter", "std_msgs/msg/String", "RIHS01_1", "string data")


def cdr(text: str) -> bytes:
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + len(data).to_bytes(4, "little") + data


class Bench:
    """A recorder whose threads are this one."""

    def __init__(
        self, folder: Path, graph: FakeGraph | None = None, now_us: int = T0, **settings: Any
    ) -> None:
        self.clock = ManualClock(now_us=now_us)
        self.told: list[Incident] = []
        self.connection = Connection(True, 100.0, 1)
        self.graph = graph
        config = RecorderConfig(folder=folder, keep_free_mb=0, **settings)
        self.recorder = Recorder(
            config,
            self.clock,
            robot="car1",
            run="0123456789abcdef",
            reserve=0,
            tell=lambda _stream, _t_us, values: self.told.append(incident(values)),
            connection=lambda: self.connection,
            graph=graph,
        )
        self.answers: list[Mapping[str, str]] = []
        self.recorder.on_answers = lambda: self.answers.append(self.recorder.answers)

    def want(self, *triggers: Trigger, takes: tuple[Take, ...] = ()) -> None:
        wanted: dict[str, Any] = {"triggers": {}, "takes": {}}
        for trigger in triggers:
            wanted["triggers"].update(encode_trigger(trigger)["recorder"]["triggers"])
        for take in takes:
            wanted["takes"].update(encode_take(take, {})["recorder"]["takes"])
        # As the shadow has it: null removes.
        for entries in wanted.values():
            for name, entry in entries.items():
                entries[name] = {key: value for key, value in entry.items() if value is not None}
        self.recorder.want(Wanted(**wanted))
        self.step()

    def step(self) -> None:
        self.recorder.step()
        self.recorder.step_slowly()


def test_the_shadow_is_followed_and_answered(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "ring")
    take = Take("a" * 16, T0 - 10 * S, T0, "anna")
    bench.want(Trigger("good", "speed > 1"), Trigger("bad", "speed_mps > 1"), takes=(take,))
    answers = bench.answers[-1]
    assert answers["good"] == answers["a" * 16] == ACCEPTED
    assert "speed_mps needs the vehicle's parameters" in answers["bad"]
    assert [one.trigger for one in bench.told] == ["take"]
    assert any("bad" in alarm for alarm in bench.recorder.alarms())
    count = len(bench.answers)
    bench.want(Trigger("good", "speed > 1"), Trigger("bad", "speed_mps > 1"), takes=(take,))
    assert len(bench.answers) == count
    assert len(bench.told) == 1
    bench.recorder.want(Wanted({}, {"b" * 16: {"from_us": 5, "to_us": 1}}))
    bench.step()
    assert bench.answers[-1] == {"b" * 16: "a take must span more than 0 and at most 1800 s"}


def test_events_fire(tmp_path: Path) -> None:
    graph = FakeGraph()
    bench = Bench(tmp_path / "ring", graph, service="/keep", topic="/keep_topic")
    call = graph.services["/keep"]
    assert call() == (False, "no trigger is for the service: iort recorder add NAME --on service")
    bench.want(*(Trigger(on, on=on, cooldown_s=0) for on in ("stop", "disconnect", "service")))
    assert call() == (True, "kept by service")
    bench.step()
    bench.clock.advance(100)
    graph.hear("/keep_topic", "std_msgs/String", string("near miss"))
    bench.step()
    bench.clock.advance(100)
    for stopped in (True, False, True, True):
        # The first one is from before this run.
        bench.recorder.stopped(stopped)
    bench.step()
    bench.clock.advance(100)
    bench.connection = Connection(False, DISCONNECT_S + 1, 1)
    bench.step()
    bench.step()
    found = [(one.trigger, one.why) for one in bench.told]
    assert found == [
        ("service", "called by a program on the robot"),
        ("service", "near miss"),
        ("stop", "the emergency stop came into force"),
        ("disconnect", "the connection was lost"),
    ]
    lost_us = bench.clock.now_us() - round((DISCONNECT_S + 1) * S)
    assert bench.told[-1].from_us == lost_us - 30 * S


def test_a_trigger_that_was_removed_while_the_agent_was_away_is_gone(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "ring")
    bench.want(Trigger("hardbrake", "speed > 1"))
    bench.recorder.close()
    bench = Bench(tmp_path / "ring")
    assert bench.recorder.answers == {"hardbrake": ACCEPTED}
    bench.want()
    assert bench.recorder.answers == {}


def test_an_agent_that_was_never_connected_has_lost_no_connection(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "ring")
    bench.want(Trigger("disconnect", on="disconnect"))
    bench.connection = Connection(False, 1000.0, 0)
    bench.step()
    assert bench.told == []


def play(emit: Emit, stop: threading.Event) -> None:
    clock, i = SystemClock(), 0
    while not clock.wait(stop, 0.02):
        now_us = clock.now_us()
        # Before the emit: who waits for the file knows when it was.
        if hard := brakes.is_set():
            brakes.clear()
            braked_us.append(now_us)
        emit("vesc", now_us, {"current_input": -20.0 if hard else 0.0})
        sent.append(cdr(f"message {i}"))
        sent_us.append(now_us)
        emit("chatter", now_us, RosMessage(sent[-1], TEXT))
        i += 1


sent: list[bytes] = []
sent_us: list[int] = []
# The car brakes hard once when it is set; when it did.
brakes = threading.Event()
braked_us: list[int] = []
RUNS: dict[Agent, tuple[Runtime, threading.Thread]] = {}


def end(agent: Agent) -> list[bytes]:
    """End a run; what it has sent."""
    runtime, thread = RUNS.pop(agent)
    runtime.stop()
    thread.join()
    return list(sent)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Callable[..., Agent]]:
    """Starts agents with a recorder, and ends them."""
    runs = RUNS

    def run(**settings: Any) -> Agent:
        for one in (sent, sent_us, braked_us):
            one.clear()
        brakes.clear()
        config = Config("car1", "host", Path(), Path(), (Script(play, "vesc", "chatter"),))
        config = replace(
            config, recorder=RecorderConfig(folder=tmp_path / "ring", keep_free_mb=0, **settings)
        )
        clock = SystemClock()
        agent = Agent(
            config, uplink=Loopback(clock, Dispatcher()), spool=MemorySpool(max_bytes=10**9), clock=clock
        )
        runtime = Runtime(agent, stopped_s=0.0)
        thread = threading.Thread(target=lambda: runtime.run(drain_s=0))
        thread.start()
        runs[agent] = runtime, thread
        return agent

    yield run
    for agent in [*runs]:
        end(agent)


def brake(agent: Agent) -> None:
    """Have the car brake, once the shadow is followed and something was heard since."""
    assert agent.recorder is not None
    until(lambda: agent.recorder is not None and agent.recorder.answers)
    heard = len(sent)
    until(lambda: len(sent) > heard + 30)
    brakes.set()


def test_others_open_the_incident_of_a_running_agent(running: Callable[..., Agent], tmp_path: Path) -> None:
    agent = running()
    assert agent.recorder is not None
    trigger = {**BRAKE, "before_s": 0.5, "after_s": 0.3, "topics": ["/chatter"]}
    agent.recorder.want(Wanted({"hardbrake": trigger}, {}))
    brake(agent)
    folder = tmp_path / "ring" / "incidents"
    until(lambda: list(folder.glob("*.mcap")))
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        mcap = reader.make_reader(file, validate_crcs=True)
        summary = mcap.get_summary()
        messages = [(channel.topic, message.data) for _, channel, message in mcap.iter_messages()]
        about = {record.name: record.metadata for record in mcap.iter_metadata()}
    assert summary is not None
    assert summary.chunk_indexes
    assert {topic for topic, _ in messages} == {"/chatter"}
    whole = [data for _, data in messages]
    first = sent.index(whole[0])
    assert whole == sent[first : first + len(whole)]
    # Also what came in the window and is a little older, or younger.
    from_us, to_us = (int(about["iort.incident"][name]) for name in ("from_us", "to_us"))
    assert (from_us, to_us) == (braked_us[0] - 500_000, braked_us[0] + 300_000)
    window = [data for data, t_us in zip(sent, sent_us) if from_us <= t_us <= to_us]
    begin = whole.index(window[0])
    assert whole[begin : begin + len(window)] == window
    assert sent[sent_us.index(braked_us[0])] in window
    account = json.loads(about["iort.account"]["/chatter"])
    assert (account["messages"], account["missing"]) == (len(whole), 0)
    assert json.loads(about["iort.incident"]["agent"])["robot"] == "car1"
    if sys.version_info >= (3, 10):  # the rosbags for older ones opens no single file
        with highlevel.AnyReader([path]) as bag:
            assert [data for _, _, data in bag.messages()] == whole

    def waiting() -> int:
        report = make_status(agent).recorder
        return report["waiting"] if report is not None else 0

    # The file is there before the plan says so.
    until(lambda: waiting() == 1, "the file to wait for its upload")
    assert "recorder  " in render(make_status(agent))


def test_a_window_begins_in_the_run_before(running: Callable[..., Agent], tmp_path: Path) -> None:
    first = running()
    assert first.recorder is not None
    first.recorder.want(Wanted({"hardbrake": {**BRAKE, "before_s": 60.0, "after_s": 0.1}}, {}))
    folder = tmp_path / "ring" / "incidents"
    until(lambda: first.recorder is not None and first.recorder.answers and len(sent) > 5)
    before = end(first)
    brake(running())
    until(lambda: list(folder.glob("*.mcap")))
    (path,) = folder.glob("*.mcap")
    with path.open("rb") as file:
        mcap = reader.make_reader(file, validate_crcs=True)
        messages = [message.data for _, _, message in mcap.iter_messages(topics=["/chatter"])]
        (about,) = [one.metadata for one in mcap.iter_metadata() if one.name == "iort.incident"]
    assert messages[: len(before)] == before
    assert messages[len(before) :] == sent[: len(messages) - len(before)]
    assert len(json.loads(about["runs"])) == 2
    assert json.loads(about["pauses"])[0][2] == "restart"


def test_the_recorder_costs_no_samples(
    running: Callable[..., Agent], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "ring").write_text("in the way")
    agent = running()
    assert agent.recorder is None
    (alarm,) = [alarm for alarm in make_status(agent).alarms if "recorder" in alarm]
    assert alarm.startswith("the recorder does not work")
    assert alarm in caplog.text
    until(lambda: len(sent) > 5)


def test_the_uploads_tell_the_recorder(running: Callable[..., Agent], tmp_path: Path) -> None:
    agent = running()
    assert agent.recorder is not None
    assert agent.uploads is not None
    folder = agent.uploads._folders[-1]
    assert folder.path == tmp_path / "ring" / "incidents"
    agent.recorder.want(Wanted({"hardbrake": {**BRAKE, "after_s": 0.1, "before_s": 0.1}}, {}))
    brake(agent)
    until(lambda: list(folder.path.glob("*.mcap")))
    (path,) = folder.path.glob("*.mcap")
    (kept,) = agent.recorder.incidents._plan.incidents.values()
    # The file is there before the plan says so.
    until(lambda: kept.state == KEPT)
    folder.on_uploaded(Path(path.name), kept.key)
    assert kept.state == UPLOADED


def test_kill_9_in_the_window_costs_less_than_a_second_of_it(tmp_path: Path) -> None:
    def start() -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", killed.__name__, str(tmp_path)])

    plan, folder = tmp_path / "ring" / "recorder.json", tmp_path / "ring" / "incidents"

    def edges() -> list[Any]:
        return json.loads(plan.read_text())["incidents"] if plan.exists() else []

    process = start()
    try:
        (open_,) = until(edges)
        process.kill()
        process.wait()
        kill_us = int((tmp_path / "sent").read_text().split()[-1])
        process = start()
        until(lambda: list(folder.glob("*.mcap")))
    finally:
        process.kill()
        process.wait()
    (path,) = folder.glob("*.mcap")
    assert path.name == f"hardbrake-{open_['id']}.mcap"
    with path.open("rb") as file:
        mcap = reader.make_reader(file, validate_crcs=True)
        found = [int(message.data) for _, _, message in mcap.iter_messages(topics=["/chatter"])]
    times = [int(line) for line in (tmp_path / "sent").read_text().split()]
    window = [t_us for t_us in times if open_["from_us"] <= t_us <= open_["to_us"]]
    lost = sorted({*window} - {*found})
    # The chunk that was open when the process was killed.
    assert all(kill_us - S < t_us <= kill_us for t_us in lost)
    # What came in it may be a little older.
    assert min(window) < kill_us
    assert min(window) in found
