"""The shadow: desired settings, rejections and reports, over an uplink in memory."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_agent.control.shadow import Shadow, _difference, _merged, overlay
from iort_agent.lanes import RuntimeSettings
from iort_agent.mqtt.dispatch import Dispatcher
from iort_contract.messages.commands import Command
from iort_contract.messages.recorder import Wanted
from iort_contract.messages.shadow import OverShare, Reported, decode_desired, encode_reported
from testkit.agent import Loopback, ManualClock, link_of

BASE = RuntimeSettings(
    record_enabled=True, live_enabled=True, live_rate_hz=10.0, ping_rate_hz=0.0, log_level="info"
)
PREFIX = "$aws/things/car1/shadow/name/agent"
DOCUMENT = encode_reported(Reported(BASE.by_name(), agent_version="1.2.3", moves=True))


class Rig:
    """A robot and its shadow, which behaves as AWS'."""

    def __init__(self, version: str = "1.2.3", recorder: Any = None, **desired: Any) -> None:
        self.clock, self.dispatcher = ManualClock(), Dispatcher()
        self.uplink = Loopback(self.clock, self.dispatcher)
        self.applied: list[RuntimeSettings] = []
        self.document: dict[str, Any] = {"desired": desired, "reported": {}} if desired else {}
        self.version = 1 if desired else 0
        self.shadow = Shadow(
            link_of(self.uplink, self.clock),
            base=BASE,
            apply=self.applied.append,
            known_fields=lambda: {"vesc": {"speed", "voltage_input"}},
            version=version,
            moves=True,
            recorder=recorder,
        )
        self.seen = 0
        self.uplink.connect()
        self.settle()

    def settle(self) -> None:
        for _ in range(4):
            self.dispatcher.run_pending()
            self.shadow.tick()
            for message in self.uplink.published[self.seen :]:
                self.answer(message.topic, message.payload)
            self.seen = len(self.uplink.published)

    def answer(self, topic: str, payload: bytes) -> None:
        if topic.endswith("/get"):
            if not self.version:
                self.deliver("get/rejected", {"code": 404, "message": "No shadow exists"})
            else:
                self.deliver("get/accepted", {"state": self.document, "version": self.version})
        elif topic.endswith("/update"):
            self.change(json.loads(payload)["state"])

    def change(self, state: dict[str, Any], *, arrives: bool = True) -> None:
        self.document = _merged(self.document, state)
        self.version += 1
        if arrives:
            self.deliver("update/accepted", {"state": state, "version": self.version})

    def desire(self, *, arrives: bool = True, **desired: Any) -> None:
        self.change({"desired": desired}, arrives=arrives)
        self.settle()

    def deliver(self, answer: str, document: Any) -> None:
        self.uplink.deliver(f"{PREFIX}/{answer}", json.dumps(document).encode())

    @property
    def reported(self) -> Any:
        return self.document.get("reported")


def test_without_a_shadow_the_agent_creates_it() -> None:
    rig = Rig()
    said = {key: value for key, value in DOCUMENT.items() if value != {}}
    assert rig.reported == said
    assert rig.applied == []


def test_an_earlier_desired_setting_is_applied() -> None:
    rig = Rig(live={"rate_hz": 2}, record={"enabled": False})
    assert rig.applied[-1].live_rate_hz == 2
    assert rig.reported["live"] == {"enabled": True, "rate_hz": 2, "when": "watched"}
    assert rig.reported["record"] == {"enabled": False}


def test_a_desired_setting_is_applied_and_removed() -> None:
    rig = Rig()
    rig.desire(log_level="debug", fields={"vesc": ["speed"]})
    assert rig.applied[-1].log_level == "debug"
    assert rig.reported["fields"] == {"vesc": ["speed"]}
    rig.desire(log_level=None, fields=None)
    assert rig.applied[-1] == BASE
    assert rig.reported["log_level"] == "info"
    assert not rig.reported["fields"]
    count = len(rig.uplink.published)
    rig.clock.advance(3600)
    rig.settle()
    assert len(rig.uplink.published) == count, "nothing more to say"


@pytest.mark.parametrize(
    ("desired", "name", "reason"),
    [
        ({"live": {"rate_hz": 50}}, "live.rate_hz", "must be a number from 0.01 to 10 (Hz), got 50"),
        ({"live": {"rate_hz": True}}, "live.rate_hz", "got True"),
        ({"live": 3}, "live", "cannot be changed"),
        ({"record": {"enabled": "no"}}, "record.enabled", "true or false"),
        ({"log_level": "loud"}, "log_level", "one of debug, info"),
        ({"fields": {"vesc": ["sped"]}}, "fields.vesc", "did you mean speed?"),
        ({"fields": {"vesc": "speed"}}, "fields.vesc", "a list of field names"),
        ({"fields": {"a b": ["speed"]}}, "fields.a b", "stream name"),
        ({"fields": {"imu": ["a b"]}}, "fields.imu[0]", "field name"),
        ({"robot": "car2"}, "robot", "cannot be changed; must be one of"),
        ({"live": {"rate": 1}}, "live.rate", "did you mean live.rate_hz?"),
    ],
)  # fmt: skip
def test_a_wrong_setting_is_rejected_with_a_reason_and_the_others_apply(
    desired: dict[str, Any], name: str, reason: str
) -> None:
    rig = Rig()
    rig.desire(**desired, ping={"rate_hz": 5})
    key = name.partition("[")[0]
    assert reason in rig.reported["rejected"][key]["reason"]
    assert f"shadow agent: {name}" in rig.reported["rejected"][key]["reason"]
    assert rig.applied[-1].ping_rate_hz == 5
    assert rig.reported["live"] == DOCUMENT["live"]


def test_a_rejected_setting_leaves_the_last_accepted_value_in_force() -> None:
    rig = Rig()
    rig.desire(live={"rate_hz": 2}, fields={"vesc": ["speed"]})
    rig.desire(live={"rate_hz": 50}, fields={"vesc": ["sped"]})
    assert rig.reported["rejected"].keys() == {"live.rate_hz", "fields.vesc"}
    assert rig.applied[-1].live_rate_hz == 2
    assert rig.reported["fields"] == {"vesc": ["speed"]}
    rig.desire(live=None, fields=None)
    assert rig.applied[-1] == BASE


def test_a_desired_value_that_is_in_force_ends_the_rejection() -> None:
    rig = Rig()
    rig.desire(live={"rate_hz": 50})
    assert rig.reported["rejected"]
    # It equals the reported value: AWS sends no delta for it.
    rig.desire(live={"rate_hz": 10})
    assert not rig.reported["rejected"]


def test_a_missed_change_is_fetched() -> None:
    rig = Rig()
    rig.desire(arrives=False, live={"rate_hz": 3})
    assert rig.applied == []
    rig.desire(ping={"rate_hz": 1})
    assert (rig.applied[-1].live_rate_hz, rig.applied[-1].ping_rate_hz) == (3, 1)


def test_a_setting_desired_while_offline_is_fetched_at_the_next_connect() -> None:
    rig = Rig()
    rig.uplink.cut()
    rig.desire(arrives=False, live={"rate_hz": 3})
    rig.uplink.connect()
    rig.settle()
    assert rig.reported["live"]["rate_hz"] == 3


def test_old_and_odd_messages_change_nothing() -> None:
    rig = Rig()
    rig.desire(live={"rate_hz": 3})
    rig.deliver("update/accepted", {"state": {"desired": {"live": {"rate_hz": 9}}}, "version": 1})
    rig.settle()
    assert [settings.live_rate_hz for settings in rig.applied] == [3], "older than what it has"
    rig.uplink.cut()
    rig.settle()
    count = len(rig.uplink.published)
    rig.clock.advance(100)
    rig.settle()
    assert len(rig.uplink.published) == count, "nothing to fetch without a connection"
    rig.uplink.connect()
    rig.settle()
    oddities: list[Any] = [[], 7]
    for odd in (
        *oddities,
        {"state": 3, "version": rig.version + 1},
        {"version": "x"},
        {"state": {"desired": 1}},
    ):
        rig.deliver("update/accepted", odd)
        rig.deliver("get/rejected", odd)
        rig.deliver("update/rejected", odd)
    rig.uplink.deliver(f"{PREFIX}/update/accepted", b"\xff")
    rig.settle()
    assert rig.shadow.settings.live_rate_hz in (3, 10)
    assert rig.applied[0].live_rate_hz == 3


def test_a_robot_over_its_share_logs_it_once_and_does_not_reject_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = Rig()
    for batches in (1, 40):
        rig.desire(over_share={"since_ms": 1000, "last_ms": 1000 + batches, "batches": batches})
    assert rig.shadow.over_share == OverShare(since_ms=1000, last_ms=1040, batches=40)
    assert rig.document["reported"].get("rejected", {}) == {}
    assert caplog.text.count("summaries are made later") == 1
    rig.desire(over_share={"since_ms": 90_000, "last_ms": 90_000, "batches": 1})
    assert caplog.text.count("summaries are made later") == 2


@pytest.mark.parametrize(
    "said",
    [5, [], {"batches": 3}]
    + [{"since_ms": 1, "last_ms": last_ms, "batches": 1} for last_ms in (-1, 10**15, True)],
)
def test_malformed_reports_about_its_share_are_ignored(said: Any) -> None:
    assert Rig(over_share=said).shadow.over_share is None


def test_an_emergency_stop_that_overtakes_the_fetched_document_is_not_missed() -> None:
    rig = Rig(live={"rate_hz": 2})
    rig.uplink.cut()
    rig.uplink.connect()
    rig.dispatcher.run_pending()
    rig.shadow.tick()
    old = {"state": copy.deepcopy(rig.document), "version": rig.version}
    rig.seen = len(rig.uplink.published)
    rig.change({"desired": {"motion": {"stopped": True}}})
    rig.deliver("get/accepted", old)
    rig.dispatcher.run_pending()
    assert not rig.shadow.known()
    rig.settle()
    assert rig.shadow.known()
    assert rig.applied[-1].motion_stopped
    assert rig.reported["motion"] == {"stopped": True}


def test_the_settings_are_unknown_without_a_connection_and_after_a_missed_change() -> None:
    rig = Rig()
    assert rig.shadow.known()
    rig.uplink.cut()
    rig.dispatcher.run_pending()
    assert not rig.shadow.known()
    rig.uplink.connect()
    rig.settle()
    assert rig.shadow.known()
    rig.change({"desired": {"log_level": "debug"}}, arrives=False)
    rig.change({"desired": {"motion": {"stopped": True}}})
    rig.dispatcher.run_pending()
    assert not rig.shadow.known()
    rig.settle()
    assert rig.applied[-1].motion_stopped


def test_an_emergency_stop_outlives_the_shadow_that_asked_for_it() -> None:
    rig = Rig(motion={"stopped": True})
    assert rig.applied[-1].motion_stopped
    rig.uplink.cut()
    rig.document, rig.version = {}, 0
    rig.uplink.connect()
    rig.settle()
    assert rig.shadow.known()
    assert rig.shadow.settings.motion_stopped
    assert rig.reported["motion"] == {"stopped": True}
    rig.change({"desired": {"motion": {"stopped": False}}})
    rig.settle()
    assert not rig.applied[-1].motion_stopped


def test_an_emergency_stop_in_a_shadow_that_was_deleted_days_ago_is_not_missed() -> None:
    rig = Rig(live={"rate_hz": 2})
    assert rig.version > 1
    # AWS counts the versions of a shadow from 0 again, 48 hours after it was deleted.
    rig.document, rig.version = {}, 0
    rig.change({"desired": {"motion": {"stopped": True}}})
    rig.dispatcher.run_pending()
    assert not rig.shadow.known(), "no motion before it is known what is asked for"
    rig.settle()
    assert rig.shadow.known()
    assert rig.applied[-1].motion_stopped


def test_a_stop_of_the_robots_own_file_is_not_the_operators_to_release() -> None:
    base = replace(BASE, motion_stopped=True)
    settings, rejected = overlay(base, base, {"motion.stopped": False}, {})
    assert settings.motion_stopped
    assert "car.yaml has motion: {stopped: true}" in rejected["motion.stopped"].reason
    assert overlay(base, base, {"motion.stopped": True}, {})[1] == {}


def test_a_robot_without_motion_does_not_seem_to_be_stopped() -> None:
    desired = {"motion.stopped": True}
    settings, rejected = overlay(BASE, BASE, desired, {}, moves=False)
    assert not settings.motion_stopped
    assert "nothing to stop" in rejected["motion.stopped"].reason
    assert overlay(BASE, BASE, {"motion.stopped": False}, {}, moves=False)[1] == {}


def test_an_unanswered_report_is_repeated() -> None:
    rig = Rig()
    rig.uplink.verdict = lambda message: "no" if message.topic.endswith("/update") else None
    rig.desire(live={"rate_hz": 3})
    assert rig.reported["live"]["rate_hz"] == 10
    rig.uplink.verdict = lambda _: None
    rig.clock.advance(31)
    rig.settle()
    assert rig.reported["live"]["rate_hz"] == 3


def test_a_long_value_is_reported_shortened() -> None:
    rig = Rig()
    rig.desire(log_level="x" * 5000)
    assert len(json.dumps(rig.reported)) < 2000


JSON = st.recursive(
    st.booleans() | st.integers() | st.text(max_size=3),
    lambda inner: st.dictionaries(st.text(max_size=2), inner, max_size=3) | st.lists(inner, max_size=2),
    max_leaves=8,
)
OBJECT = st.dictionaries(st.text(max_size=2), JSON, max_size=4)


def bare(value: Any) -> Any:
    """Without empty objects: a shadow does not distinguish them from missing ones."""
    if not isinstance(value, dict):
        return value
    inner = {key: bare(item) for key, item in value.items()}
    return {key: item for key, item in inner.items() if item != {}}


@given(OBJECT, OBJECT)
def test_merging_the_difference_into_the_old_gives_the_new(old: dict[str, Any], new: dict[str, Any]) -> None:
    assert bare(_merged(old, _difference(old, new))) == bare(new)


@given(OBJECT)
def test_no_desired_value_raises(desired: dict[str, Any]) -> None:
    settings, rejected = overlay(BASE, BASE, decode_desired(desired).settings, {})
    assert 0.01 <= settings.live_rate_hz <= 10
    json.dumps(rejected)


class Compared(str):
    """Calls a function when it is compared the ``count``-th time: in the middle of a report."""

    __slots__ = ("call", "count")
    call: Any
    count: int

    def __ne__(self, other: object) -> bool:
        self.count -= 1
        if not self.count:
            self.call()
        return super().__ne__(other)

    __hash__ = str.__hash__


@pytest.mark.parametrize("count", [1, 2])
def test_an_outcome_that_comes_while_a_report_is_made_is_reported(count: int) -> None:
    version = Compared("1.2.3")
    version.count = 0
    rig = Rig(version)
    command = Command("feedbeef", 1, 7, 2, 500, {}, answer=True)
    version.count, version.call = count, lambda: rig.shadow.answer("late", command, None)
    rig.shadow.answer("drive", command, None)
    rig.settle()
    assert version.count <= 0
    assert rig.reported["commands"]["late"]["seq"] == 7


def test_outcomes_of_commands_are_reported_until_the_run_ends() -> None:
    rig = Rig(live={"rate_hz": 2})
    command = Command("feedbeef", 1, 7, 2, 500, {}, answer=True)
    rig.shadow.answer("drive", command, None)
    rig.settle()
    assert rig.reported["commands"]["drive"] == {"session": "feedbeef", "seq": 7, "outcome": "accepted"}
    rig.shadow.answer("drive", replace(command, seq=8), "stale" * 100)
    rig.settle()
    assert rig.reported["commands"]["drive"]["seq"] == 8
    assert len(rig.reported["commands"]["drive"]["outcome"]) < 250
    rig.shadow._answers.clear()
    rig.shadow._follow()
    rig.settle()
    assert not rig.reported.get("commands")


def test_unknown_names_do_not_fill_the_shadow() -> None:
    rig = Rig()
    for i in range(40):
        rig.shadow.answer(f"name{i}", Command("feedbeef", 1, i, 2, 500, {}), "no such command")
    rig.settle()
    assert list(rig.reported["commands"]) == [f"name{i}" for i in range(24, 40)]


class Keeper:
    """A recorder that answers when it likes."""

    def __init__(self) -> None:
        self.answers: dict[str, str] = {}
        self.wanted: list[Wanted] = []

    def want(self, wanted: Wanted) -> None:
        self.wanted.append(wanted)


TRIGGERS = {"triggers": {"hardbrake": {"when": "current_input < -15"}}}


def test_the_recorder_is_told_what_is_wanted_and_its_answers_are_reported() -> None:
    keeper = Keeper()
    rig = Rig(recorder=keeper)
    rig.desire(recorder=TRIGGERS)
    assert keeper.wanted[-1].triggers == TRIGGERS["triggers"]
    assert not rig.reported.get("recorder")
    keeper.answers = {"hardbrake": "accepted"}
    rig.shadow.tell()
    rig.settle()
    assert rig.reported["recorder"] == {"hardbrake": "accepted"}
    rig.desire(recorder=None)
    assert keeper.wanted[-1] == Wanted()
    assert not rig.reported.get("rejected")


def test_a_robot_without_a_recorder_says_so() -> None:
    rig = Rig()
    rig.desire(recorder=TRIGGERS)
    assert rig.reported["recorder"] == {
        "hardbrake": "the robot has no recorder: car.yaml has no section recorder"
    }
