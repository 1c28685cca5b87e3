"""Commands and settings: what `iort send` says, and how a robot's shadow is read."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from iort_contract.messages.commands import DRIVEN_BY_ANOTHER, NO_LEASE, NO_PICTURE, Command, decode_command
from iort_contract.messages.shadow import OverShare, Reported, decode_desired, decode_reported
from iort_contract.messages.video import VideoTerms, encode_terms
from iort_station.cli.verbs.control import commands
from iort_station.errors import StationError, UsageError
from iort_station.fleet.control import State, _check_clock, outcome, over_share, settled, slept
from iort_station.page import answers


class Cloud:
    """A cloud with one robot, which answers each command with ``outcome``; None: it does not."""

    namespace = "iort"

    class exceptions:
        class ResourceNotFoundException(Exception):
            """There is no shadow."""

    def __init__(self, outcome: str | None = "accepted", *, online: bool = True, video: Any = None) -> None:
        self.outcome, self.online, self.video = outcome, online, video or {}
        self.sent: list[Command] = []

    def client(self, _service: str) -> Cloud:
        return self

    def output(self, _noun: str, name: str) -> str:
        return name

    def describe_thing(self, *, thingName: str) -> dict[str, Any]:
        return {"thingName": thingName, "ResponseMetadata": {"HTTPHeaders": {}}}

    def get_item(self, **_asked: Any) -> dict[str, Any]:
        return {"Item": {"robot": {"S": "car7"}, "online": {"BOOL": self.online}}}

    def publish(self, *, topic: str, qos: int, payload: bytes) -> None:
        assert (topic, qos) == ("cmd/iort/car7/drive", 1)
        self.sent.append(decode_command(payload))

    def get_thing_shadow(self, **_asked: Any) -> dict[str, Any]:
        said = {}
        if self.outcome is not None and self.sent:
            (*_, one) = self.sent
            said = {"drive": {"session": one.session, "seq": one.seq, "outcome": self.outcome}}
        reported = {"commands": said, "video": self.video}
        return {"payload": io.BytesIO(json.dumps({"state": {"reported": reported}}).encode())}


def send(cloud: Cloud, *options: str) -> Any:
    asked = SimpleNamespace(cloud=lambda: cloud)
    return CliRunner().invoke(commands, ["send", "car7", "drive", "{}", *options], obj=asked)


@pytest.mark.parametrize(("options", "takeover"), [((), False), (("--takeover",), True)])
def test_the_wheel_is_taken_only_if_that_is_asked_for(options: tuple[str, ...], takeover: bool) -> None:
    cloud = Cloud()
    assert send(cloud, *options).exit_code == 0
    asked = {
        "robot": "car7",
        "command": "drive",
        "message": "{}",
        **({"takeover": "true"} if takeover else {}),
    }
    assert slept(answers.send(cloud, asked))["accepted"]  # type: ignore[arg-type]  # a fake
    assert [command.takeover for command in cloud.sent] == [takeover, takeover]


VIDEO = encode_terms(VideoTerms(640, 480, 15.0))
MOVES = ("--lease-ms", "500")


@pytest.mark.parametrize(
    ("video", "options", "blind"),
    [
        (VIDEO, (*MOVES, "--blind"), True),
        (VIDEO, (), False),  # what moves nothing needs no picture
        ({}, MOVES, False),
        ({}, (*MOVES, "--blind"), True),
    ],
)
def test_a_car_with_a_camera_is_moved_from_a_terminal_blind(
    video: Any, options: tuple[str, ...], blind: bool
) -> None:
    cloud = Cloud(video=video)
    assert send(cloud, *options).exit_code == 0
    assert [(command.blind, command.frame) for command in cloud.sent] == [(blind, None)]


def test_without_that_nothing_is_sent_and_the_refusal_says_what_to_do() -> None:
    cloud = Cloud(video=VIDEO)
    done = send(cloud, *MOVES)
    assert isinstance(done.exception, UsageError)
    assert "Drive it on the page, or move it blind (--blind)" in str(done.exception)
    asked = {"robot": "car7", "command": "drive", "message": "{}", "lease_ms": "500"}
    with pytest.raises(UsageError, match="takes no motion without its picture"):
        slept(answers.send(cloud, asked))  # type: ignore[arg-type]  # a fake
    assert cloud.sent == []
    assert slept(answers.send(cloud, {**asked, "blind": "true"}))["accepted"]  # type: ignore[arg-type]  # a fake
    assert [command.blind for command in cloud.sent] == [True]


@pytest.mark.parametrize(
    ("outcome", "advice"),
    [(NO_LEASE, "--lease-ms"), (DRIVEN_BY_ANOTHER, "--takeover"), (NO_PICTURE, "--blind")],
)
def test_a_rejection_says_what_helps(outcome: str, advice: str) -> None:
    done = send(Cloud(f"{outcome.replace('_', ' ')}, sent 0.031 s ago, by its own clock"))
    assert advice in str(done.exception)
    assert done.exit_code == 1


def test_a_robot_that_is_away_is_told_at_once_and_hardly_waited_for() -> None:
    done = send(Cloud(None, online=False), "--seconds", "3600")
    assert "car7 is not connected" in done.stderr
    assert "car7 is not connected, and has not answered" in str(done.exception)


def test_a_robot_of_which_the_registry_does_not_know_may_still_answer() -> None:
    assert send(Cloud(online=False)).stdout == "car7 has accepted drive\n"


REPORTED = {
    "live": {"enabled": True, "rate_hz": 10},
    "fields": {"vesc": ["speed"]},
    "log_level": "info",
    "rejected": {"ping.rate_hz": {"value": 99, "reason": "ping.rate_hz: found 99"}},
    "commands": {"drive": {"session": "feedbeef", "seq": 3, "outcome": "accepted"}},
}
STATE = State(reported=decode_reported(REPORTED))


def test_settings_and_rejections_are_read_from_the_report():
    assert STATE.reported.settings == {
        "fields.vesc": ["speed"], "live.enabled": True, "live.rate_hz": 10, "log_level": "info",
    }  # fmt: skip
    assert STATE.reported.rejected == {"ping.rate_hz": (99, "ping.rate_hz: found 99")}


def test_a_desired_setting_is_pending_until_the_robot_applies_or_rejects_it():
    desired = {"live": {"rate_hz": 5, "enabled": True}, "ping": {"rate_hz": 99}, "fields": {"imu": []}}
    state = State(decode_desired(desired), STATE.reported)
    assert state.pending() == {"live.rate_hz": 5}
    assert State(decode_desired(desired)).pending().keys() == {"live.rate_hz", "live.enabled", "ping.rate_hz"}


def test_a_rejection_of_an_earlier_value_does_not_reject_the_desired_one():
    """A robot that is offline still has the old one in its report."""
    older = State(decode_desired({"ping": {"rate_hz": 99}}), STATE.reported)
    assert older.rejected().keys() == {"ping.rate_hz"}
    newer = State(decode_desired({"ping": {"rate_hz": 9}}), STATE.reported)
    assert (newer.rejected(), newer.pending()) == ({}, {"ping.rate_hz": 9})
    assert STATE.rejected() == {}


class ShadowMissingError(Exception):
    """The thing has no shadow of this name."""


class Data:
    """A cloud with one shadow, or none."""

    exceptions = SimpleNamespace(ResourceNotFoundException=ShadowMissingError)

    def __init__(self, desired):
        self.desired = desired

    def client(self, service):
        assert service == "iot-data"
        return self

    def get_thing_shadow(self, *, thingName, shadowName):
        assert (thingName, shadowName) == ("car", "agent")
        if self.desired is None:
            raise ShadowMissingError
        return {"payload": io.BytesIO(json.dumps({"state": {"desired": self.desired}}).encode())}


def test_the_clouds_notice_of_a_share_is_no_desired_setting():
    said = {"since_ms": 1, "last_ms": 2, "batches": 3}
    assert decode_desired({"over_share": said, "log_level": "debug"}).settings == {"log_level": "debug"}
    assert over_share(Data({"over_share": said}), "car") == OverShare(batches=3, since_ms=1, last_ms=2)
    assert over_share(Data(None), "car") is None
    # The robot can also write here.
    for odd in (None, [], {}, said | {"last_ms": 10**30}, said | {"batches": "3"}, said | {"since_ms": -1}):
        assert over_share(Data({"over_share": odd}), "car") is None


@pytest.mark.parametrize(
    ("desired", "said"),
    [
        ({"live.rate_hz": 10}, True),
        ({"live.rate_hz": 10.0, "fields.vesc": ["speed"]}, True),
        ({"live.rate_hz": 5}, None),
        ({"live.rate_hz": 10, "log_level": "debug"}, None),
        ({"fields.vesc": []}, None),
        ({"fields.imu": []}, True),
        ({"ping.rate_hz": 99}, True),
        # The rejected value belongs to an older desired setting.
        ({"ping.rate_hz": 98}, None),
        # The setting was withdrawn, and the robot has not seen it yet.
        ({"ping.rate_hz": None}, None),
        ({"live.rate_hz": None}, True),
    ],
)
def test_an_answer_is_recognised_for_each_desired_setting(desired, said):
    assert settled(desired, STATE) is said


def test_a_long_rejected_value_is_recognised_by_its_beginning():
    long = ["x" * 300]
    rejected = {"fields.vesc": {"value": ('["' + "x" * 300)[:200] + "...", "reason": "no"}}
    state = State(reported=decode_reported({"rejected": rejected}))
    assert settled({"fields.vesc": long}, state)
    assert settled({"fields.vesc": ["y" * 300]}, state) is None


def test_the_outcome_of_a_command_is_read_by_run_and_number():
    assert outcome(STATE, "drive", "feedbeef", 3) == "accepted"
    assert outcome(STATE, "drive", "feedbeef", 4) is None
    assert outcome(STATE, "drive", "0badcafe", 3) is None
    assert outcome(State(), "drive", "feedbeef", 3) is None


def test_a_wrong_clock_is_refused():
    date, cloud_s = "Sat, 21 Nov 2026 10:00:00 GMT", 1_795_255_200
    _check_clock(None, 0, 0)
    for off_s in (-2.0, 0.0, 2.9):
        _check_clock(date, cloud_s + off_s, cloud_s + off_s)
    for off_s in (-3.0, 4.0, 86_400.0):
        with pytest.raises(StationError, match="set it"):
            _check_clock(date, cloud_s + off_s, cloud_s + off_s)


@pytest.mark.parametrize("said", ["x", 7, [1], {"drive": "x"}])
def test_an_invalid_report_is_read_as_empty(said):
    assert decode_reported({"commands": said, "rejected": said}) == Reported()
