"""Triggers and takes of the event recorder: checked against what is recorded, written, and answered."""

from __future__ import annotations

import io
import json
from typing import Any

import pytest
from typer.testing import CliRunner

from iort_agent.control.shadow import _merged
from iort_contract.catalog.streams import INCIDENT_STREAM, TYPES_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.messages.recorder import (
    KEPT,
    LOST,
    MAX_TRIGGERS,
    UPLOADED,
    Incident,
    Take,
    Trigger,
    decode_take,
    decode_trigger,
    incident_id,
)
from iort_contract.ros.message import MessageType
from iort_contract.topics import ACCEPTED, RECORD, build_topic
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.data import incidents, triggers
from iort_station.errors import StationError, UsageError
from iort_station.fleet import control, recorder
from testkit.dynamodb import ROBOTS, TELEMETRY, FakeDynamoDB, item_of, serialize
from tests.unit.station.data.test_queries import FakeCloud

START = 1_700_000_000_000_000
S = 1_000_000


class Lab(FakeCloud):
    """A cloud with the robots car and van, which have recorded something, and their shadows. ``says`` is what
    a robot answers to every trigger and take; nothing if it is empty."""

    class exceptions:
        class ResourceNotFoundException(Exception):
            """There is no such thing, or no shadow of it."""

        class ConflictException(Exception):
            """The shadow has another version."""

    def __init__(self, says: str = ACCEPTED, *, online: bool = True) -> None:
        super().__init__(FakeDynamoDB(page_items=100))
        self.says, self.states, self.version = says, dict[str, Any](), 0
        # Called when a shadow has been read, before it is changed.
        self.meanwhile = lambda: None
        for robot, gain in (("car", 4614), ("van", 0)):
            row = {"robot": robot, "online": online, "speed_to_erpm_gain": gain, "streams": {"vesc", "pose"}}
            self.table.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
            self.record(
                "vesc", {"speed": [0, 9000, 0], "mode": ["go"] * 3, "fault_code": [0] * 3}, robot=robot
            )
            self.record("pose", {"x": [0.0, 1.0, 2.0]}, robot=robot)
        scan = MessageType("scan", "/front/scan", "sensor_msgs/LaserScan", "1", "").sample()
        self.record(TYPES_STREAM, {name: [value] for name, value in scan.items()})

    def record(
        self, stream: str, columns: dict[str, list[Any]], t_us: int = START, robot: str = "car"
    ) -> None:
        times = [t_us + i * 100_000 for i in range(len(next(iter(columns.values()))))]
        seq = len(self.table.items[TELEMETRY])
        batch = Batch("0badcafe", seq, times, columns)
        self.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, robot, stream)))

    def tell(self, incident: Incident, t_us: int, robot: str = "car") -> None:
        """Record a sample of an incident."""
        sample = {name: [value] for name, value in incident.sample().items()}
        self.record(INCIDENT_STREAM, sample, t_us, robot)

    def client(self, service: str) -> Any:
        return self if service.startswith("iot") else super().client(service)

    def describe_thing(self, *, thingName: str) -> dict[str, Any]:
        if thingName not in {"car", "van"}:
            raise self.exceptions.ResourceNotFoundException
        return {"ResponseMetadata": {"HTTPHeaders": {}}}

    def get_thing_shadow(self, *, thingName: str, shadowName: str) -> dict[str, Any]:
        if thingName not in self.states:
            raise self.exceptions.ResourceNotFoundException
        document = json.dumps({"state": self.states[thingName], "version": self.version}).encode()
        self.meanwhile()
        return {"payload": io.BytesIO(document)}

    def update_thing_shadow(self, *, thingName: str, shadowName: str, payload: str) -> None:
        document = json.loads(payload)
        if document.get("version", self.version) != self.version:
            raise self.exceptions.ConflictException
        self.version += 1
        state = self.states[thingName] = _merged(self.states.get(thingName, {}), document["state"])
        wanted = state["desired"]["recorder"]
        if self.says:
            names = [*wanted.get("triggers", {}), *wanted.get("takes", {})]
            state["reported"] = {"recorder": dict.fromkeys(names, self.says)}

    def triggers(self, robot: str = "car") -> dict[str, Any]:
        return dict(self.states.get(robot, {}).get("desired", {}).get("recorder", {}).get("triggers", {}))

    def takes(self, robot: str = "car") -> dict[str, Take]:
        wanted = self.states.get(robot, {}).get("desired", {}).get("recorder", {}).get("takes", {})
        return {name: decode_take(name, content) for name, content in wanted.items()}


@pytest.fixture
def lab(monkeypatch):
    monkeypatch.setattr(control.time, "sleep", lambda _s: None)
    return Lab()


@pytest.fixture
def iort(lab, monkeypatch):
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: lab)
    return lambda *words: CliRunner().invoke(app, words, env={"COLUMNS": "160"})


BRAKE = Trigger("brake", when="delta(speed, 1s) < -3000 and speed_mps > 0.5 for 200ms")


def test_a_trigger_gets_the_vehicles_parameters_and_the_streams_of_its_condition(lab):
    assert triggers.checked(lab, "car", BRAKE).gain == 4614
    found = triggers.checked(lab, "car", Trigger("far", when="pose.x > 100 and speed > 0"))
    assert (found.others, found.gain) == (("pose",), 0)
    assert triggers.checked(lab, "car", Trigger("fault", on="fault")).stream == "vesc"
    # As little as possible is in the shadow.
    assert triggers.checked(lab, "car", Trigger("stops", on="stop")) == Trigger("stops", on="stop")


@pytest.mark.parametrize(
    ("trigger", "said"),
    [
        (
            Trigger("t", when="sped > 3"),
            "car has no sped in vesc .with --new it is added all the same.; the n",
        ),
        (Trigger("t", when="x > 3", stream="poes"), "car has no stream poes .*; the nearest: pose"),
        (Trigger("t", when="silent(imu, 1s)"), "car has no stream imu"),
        (Trigger("t", when="power_w > 3"), "car has no power_w in vesc"),
        (Trigger("t", when="mode > 3"), "the condition cannot be evaluated: .*mode"),
        (Trigger("t", when="speed >"), "speed >"),
        (Trigger("t", on="stop", topics=("/camera/*",)), "no topic and no stream that matches /camera/\\*"),
        (Trigger("t", on="stop", before_s=601), "before must be 0 to 600 s, got 601"),
        (Trigger("t"), "needs either a condition"),
        (Trigger("t", when="silent(log, 1s)"), "log is the agent's own stream, which fires no trigger"),
        (Trigger("t t", on="stop"), "trigger name"),
    ],
)
def test_a_trigger_that_cannot_fire_is_an_error(lab, trigger, said):
    with pytest.raises(StationError, match=said):
        triggers.checked(lab, "car", trigger)


def test_a_derived_field_needs_the_cars_gain_also_if_it_is_new(lab):
    with pytest.raises(StationError, match="speed_mps needs the speed_to_erpm_gain of van"):
        triggers.checked(lab, "van", BRAKE, new=True)


def test_a_field_that_is_not_recorded_any_more_may_fire(lab):
    lab.record("vesc", {"speed": [1, 2]}, START + 60 * S)
    trigger = Trigger("t", when="fault_code != 0 and speed > 3")
    assert triggers.checked(lab, "car", trigger) == trigger


def test_what_is_said_to_come_is_not_looked_for(lab):
    trigger = Trigger("t", when="sped > 3 and silent(imu, 1s)", topics=("/camera/*",))
    assert triggers.checked(lab, "car", trigger, new=True) == trigger


@pytest.mark.parametrize("pattern", ["/front/*", "*scan", "/front/scan", "vesc", "po*"])
def test_topics_and_streams_match_patterns(lab, pattern):
    assert triggers.checked(lab, "car", Trigger("t", on="stop", topics=(pattern,))).topics == (pattern,)


def test_a_robot_accepts_a_trigger_and_it_is_listed_beside_its_answer(lab, iort):
    done = iort("recorder", "add", "brake", "--robots", "car", "--when", BRAKE.when, "--after", "0s",
                "--topics", "/front/*,vesc", "--budget", "0.5GB/day", "--cooldown", "2m")  # fmt: skip
    assert (done.exit_code, done.stdout) == (0, "car: brake: accepted\n"), done.output
    trigger = decode_trigger("brake", lab.triggers()["brake"])
    assert (trigger.before_s, trigger.after_s, trigger.cooldown_s) == (30, 0, 120)
    assert (trigger.budget_mb_day, trigger.topics, trigger.gain) == (500, ("/front/*", "vesc"), 4614)

    (told,) = json.loads(iort("recorder", "list", "--json").stdout)
    assert (told["robot"], told["answer"], told["trigger"]["when"]) == ("car", "accepted", BRAKE.when)
    assert "accepted" in iort("recorder", "list").stdout
    assert "no triggers" in iort("recorder", "list", "van").stderr

    assert iort("recorder", "remove", "brake", "--robots", "car").exit_code == 0
    assert lab.triggers() == {}
    unknown = iort("recorder", "remove", "brake", "--robots", "car").exception
    assert "car has no trigger brake" in str(unknown)


def test_nothing_is_changed_if_one_of_the_robots_cannot_have_it(lab, iort):
    done = iort("recorder", "add", "brake", "--robots", "car,van", "--when", BRAKE.when)
    assert "of van" in str(done.exception)
    assert lab.states == {}


def test_a_trigger_that_the_robot_refuses_is_taken_back_and_what_was_there_before_stays(lab, iort):
    recorder.add(lab, "car", BRAKE, 0)
    lab.says = "costs too much"
    done = iort("recorder", "add", "brake", "--robots", "car", "--on", "stop")
    assert done.stdout == "car: brake: refused: costs too much\n"
    assert "refused by car: it is taken back" in str(done.exception)
    assert decode_trigger("brake", lab.triggers()["brake"]) == BRAKE
    iort("recorder", "add", "other", "--robots", "car", "--on", "stop")
    assert lab.triggers().keys() == {"brake"}
    # It may be accepted once its stream comes.
    iort("recorder", "add", "other", "--robots", "car", "--on", "stop", "--new")
    assert lab.triggers().keys() == {"brake", "other"}


def test_a_robot_that_does_not_answer_is_named_and_one_that_is_away_gets_it_later(lab, iort, monkeypatch):
    lab.says = ""
    add = ("recorder", "add", "stops", "--on", "stop", "--seconds", "0.01", "--robots")
    assert "no answer from car within 0.01 s" in str(iort(*add, "car").exception)
    monkeypatch.setattr(lab, "table", Lab(online=False).table)
    done = iort(*add, "car")
    assert (done.exit_code, done.stdout) == (0, "car: stops: not connected: it answers when it is back\n")
    assert "not answered yet" in iort("recorder", "list").stdout


def test_a_robot_has_only_so_many_triggers(lab):
    for number in range(MAX_TRIGGERS):
        recorder.add(lab, "car", Trigger(f"t{number}", on="stop"), 0)
    with pytest.raises(UsageError, match="car has 8 triggers, the most allowed: t0, t1"):
        recorder.add(lab, "car", Trigger("another", on="stop"), 0)
    recorder.add(lab, "car", Trigger("t0", on="disconnect"), 0)
    assert decode_trigger("t0", lab.triggers()["t0"]).on == "disconnect"


def test_what_this_station_cannot_read_is_listed_with_the_reason(lab):
    lab.states["car"] = {"desired": {"recorder": {"triggers": {"later": {"on": "flood"}}}}}
    (listed,) = recorder.triggers(lab, ["car"])
    assert listed.trigger is None
    assert "on must be one of" in listed.problem


def test_a_name_that_nobody_has_claimed_yet_has_no_triggers(lab, iort):
    recorder.add(lab, "car", BRAKE, 0)
    lab.table.put(ROBOTS, {"robot": serialize("unclaimed")})
    assert len(json.loads(iort("recorder", "list", "--json").stdout)) == 1
    assert "no triggers" in iort("recorder", "list", "unclaimed").stderr
    assert "robot ca is not registered" in str(iort("recorder", "list", "ca").exception)


def test_changes_of_others_at_the_same_time_are_not_lost(lab):
    lab.states["car"] = {"desired": {}}
    others = [lambda: recorder.add(lab, "car", Trigger("theirs", on="stop"), 0)]

    def meanwhile():
        if others:
            others.pop()()

    lab.meanwhile = meanwhile
    recorder.add(lab, "car", Trigger("mine", on="stop"), 0)
    assert lab.triggers().keys() == {"mine", "theirs"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--budget", "much"], "--budget must be MB or GB a day"),
        (["--before", "soon"], "duration must be"),
        (["--when", "speed > 3"], "either a condition"),
        (["--before", "1h"], "before must be 0 to 600 s, got 3600"),
    ],
)
def test_options_that_nobody_could_mean_are_errors(iort, lab, options, said):
    done = iort("recorder", "add", "t", "--robots", "car", "--on", "stop", *options)
    assert said in str(done.exception)
    assert lab.states == {}


def test_a_take_is_followed_to_its_upload(lab, iort, monkeypatch):
    states = [(KEPT, 0), (KEPT, 2_000_000), (UPLOADED, 2_000_000)]

    def step(_s: float) -> None:
        if states and (takes := lab.takes()):
            (taken,) = takes.values()
            state, size = states.pop(0)
            one = incident_id("car", taken.id, 0)
            told = Incident(one, "take", taken.from_us, taken.to_us, state, why=taken.why, bytes=size)
            lab.tell(told, taken.to_us + 3 * S - len(states) * S)

    monkeypatch.setattr(control.time, "sleep", step)
    done = iort("recorder", "take", "car", "--last", "60s", "--why", "a bump")
    assert done.exit_code == 0, done.output
    assert "uploaded" in done.stdout
    assert "2.0 MB" in done.stdout
    (taken,) = lab.takes().values()
    assert (taken.to_us - taken.from_us, taken.why) == (60 * S, "a bump")
    assert "@" in taken.by


def test_a_take_of_which_nothing_is_left_is_an_error(lab, iort, monkeypatch):
    def step(_s: float) -> None:
        (taken,) = lab.takes().values()
        one = incident_id("car", taken.id, 0)
        lab.tell(Incident(one, "take", taken.from_us, taken.to_us, LOST, why="the ring has nothing"), START)

    monkeypatch.setattr(control.time, "sleep", step)
    monkeypatch.setattr(incidents, "_SLACK_US", 10**16)
    done = iort("recorder", "take", "car", "--last", "60s", "--json")
    assert "nothing is uploaded: lost, the ring has nothing" in str(done.exception)
    assert json.loads(done.stdout)["incident"]["state"] == "lost"


def test_a_take_that_became_part_of_an_open_incident_is_found_there(lab):
    old = Incident("0badcafe", "take", START, START + 60 * S, KEPT)
    lab.tell(old, START + 60 * S)
    taken = Take("feedbeef", START + 10 * S, START + 50 * S)
    before = incidents.incidents(lab, "car")
    assert incidents.of_take(lab, "car", taken, before) is None
    lab.tell(Incident("0badcafe", "brake,take", START, START + 60 * S, UPLOADED), START + 70 * S)
    found = incidents.of_take(lab, "car", taken, before)
    assert found is not None
    assert found.incident.state == UPLOADED


def test_a_robot_that_refuses_a_take_or_is_away_says_so(lab, iort, monkeypatch):
    lab.says = "the ring is off"
    assert "car has refused it: the ring is off" in str(
        iort("recorder", "take", "car", "--last", "60s").exception
    )
    lab.says = ""
    silent = iort("recorder", "take", "car", "--last", "60s", "--seconds", "0.01")
    assert "has its car.yaml the section recorder?" in str(silent.exception)
    monkeypatch.setattr(lab, "table", Lab(online=False).table)
    away = iort("recorder", "take", "car", "--last", "60s", "--seconds", "0.01")
    assert (away.exit_code, away.stdout) == (
        0, "car is not connected: it keeps this when it is back, as far as its ring reaches\n",
    )  # fmt: skip
    assert len(lab.takes()) == 3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "give --last 60s, or --from and --to"),
        (["--last", "2h"], "must span more than 0 and at most 1800 s; nothing is taken"),
    ],
)
def test_a_take_has_a_time_that_a_recorder_keeps(iort, lab, options, said):
    assert said in str(iort("recorder", "take", "car", *options).exception)
    assert lab.states == {}
