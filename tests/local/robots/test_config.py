"""`iort config` and `iort send` with a running agent on the embedded cloud."""

from __future__ import annotations

import json

import pytest

from iort_contract.catalog.streams import LOG_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.commands import DRIVE_TYPE
from iort_contract.tables import ONLINE
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.fleet.control import slept
from iort_station.operations import audit
from iort_station.page import answers
from testkit.waiting import until
from tests.local.data.drives import Agent


def settings(outcome):
    return json.loads(outcome.output)["settings"]


def test_a_running_agent_applies_a_setting_and_answers(iort, bundle, embedded):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}])
    with Agent(car):
        # For a robot that the registry does not know to be connected, the command waits only shortly.
        until(lambda: registry.get(embedded.cloud, car.robot).get(ONLINE))
        changed = iort("config", car.robot, "live.rate_hz=2", "fields.vesc=speed,voltage_input",
                       "log_level=debug", "--seconds", "120", "--json")  # fmt: skip
        assert changed.exit_code == 0, changed.output + str(changed.exception)
        assert settings(changed)["live.rate_hz"] == 2
        assert settings(changed)["fields.vesc"] == ["speed", "voltage_input"]
        until(
            lambda: (
                {"speed", "voltage_input"}
                in [set(batch.columns) for batch in audit.batches(embedded.cloud, car.robot, "vesc")]
            )
        )
        invalid = iort("config", car.robot, "live.rate_hz=50", "ping.rate_hz=1")
        assert isinstance(invalid.exception, UsageError)
        assert "must be a number from 0.01 to 10 (Hz), got 50; nothing is changed" in str(invalid.exception)
        # Only the robot knows the fields of its streams.
        refused = iort(
            "config", car.robot, "fields.vesc=sped", "ping.rate_hz=1", "--seconds", "120", "--json"
        )
        assert refused.exit_code == 1
        answer = json.loads(refused.output)
        assert answer["rejected"].keys() == {"fields.vesc"}
        assert answer["rejected"]["fields.vesc"]["value"] == ["sped"]
        assert "did you mean speed?" in answer["rejected"]["fields.vesc"]["reason"]
        assert answer["settings"]["fields.vesc"] == ["speed", "voltage_input"]
        assert answer["settings"]["ping.rate_hz"] == 1
        # The rejected change is withdrawn, and the last accepted one is desired again.
        until(lambda: "rejected" not in iort("config", car.robot).output)
        shown = iort("config", car.robot)
        assert "fields.vesc=speed,voltage_input\n" in shown.output
        withdrawn = iort("config", car.robot, "--unset", "live.rate_hz", "--unset", "fields.vesc",
                         "--seconds", "120", "--json")  # fmt: skip
        assert withdrawn.exit_code == 0, withdrawn.output
        assert settings(withdrawn)["live.rate_hz"] == 10
        assert "fields.vesc" not in settings(withdrawn)
        # This car.yaml has no commands: the agent says so, and nobody waits.
        unknown = iort("send", car.robot, "drive", "{}", "--valid-ms", "60000", "--seconds", "60")
        assert "no such command; car.yaml has no downlink.cmd" in str(unknown.exception)


def test_a_change_for_an_offline_robot_is_pending(iort, bundle):
    car = bundle()
    asked = iort("config", car.robot, "live.rate_hz=3", "--seconds", "0.1")
    assert asked.exit_code == 0
    assert "live.rate_hz=?  (pending: 3)" in asked.stdout
    assert f"pending: {car.robot} is offline, and applies it when it is back" in asked.stderr
    assert json.loads(iort("config", car.robot, "--json").output)["pending"] == {"live.rate_hz": 3}
    # It would take every setting of the section with it.
    unknown = iort("config", car.robot, "--unset", "live", "--seconds", "0.1")
    assert "'live' cannot be changed" in str(unknown.exception)
    assert json.loads(iort("config", car.robot, "--json").output)["pending"] == {"live.rate_hz": 3}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("config", "CAR", "live.rate_hz"), "must be NAME=VALUE"),
        (("send", "CAR", "drive", "{"), "must be JSON"),
        (("send", "CAR", "drive", "7"), "must be a JSON object"),
        (("send", "CAR", "a/b", "{}"), "got 'a/b'"),
    ],
)
def test_an_invalid_value_is_rejected_with_the_reason(iort, bundle, arguments, said):
    car = bundle()
    named = [car.robot if part == "CAR" else part for part in arguments]
    assert said in str(iort(*named).exception)


def test_a_simulated_car_obeys_a_command_and_its_log_lines_are_recorded(iort, bundle, embedded):
    source = {"type": "sim", "rate_hz": 50, "vehicle": {"max_speed_mps": 5}}
    motion = {"lease_s": 10, "stop": {}}
    drive = {"topic": "/drive", "type": DRIVE_TYPE, "partial": True, "motion": motion}
    car = bundle(sources=[source], downlink={"cmd": {"drive": drive}}, ping={"rate_hz": 2})
    asked = ("send", car.robot, "drive", '{"drive": {"speed": -1.0}}', "--lease-ms", "3000")

    def recorded(stream, field):
        batches = audit.batches(embedded.cloud, car.robot, stream)
        return [value for batch in batches for value in batch.columns[field]]

    with Agent(car):
        # It accepts no motion before it knows the cloud's clock.
        until(lambda: iort(*asked).exit_code == 0)
        # The page's server does what both commands do.
        again = {"robot": car.robot, "command": "drive", "message": '{"drive": {"speed": -1.0}}'}
        # On a slow machine it is too late, and what is changed is not confirmed in time.
        until(lambda: slept(answers.send(embedded.cloud, again))["reason"].startswith("without lease, sent "))
        until(lambda: slept(answers.send(embedded.cloud, {**again, "lease_ms": "3000"}))["accepted"])
        rate = {"robot": car.robot, "name": "live.rate_hz", "value": "4"}

        def changed() -> bool:
            told = answers.change(embedded.cloud, rate)["settings"]
            (entry,) = (one for one in told if one["name"] == "live.rate_hz")
            return (entry["value"], entry["desired"], entry["pending"]) == ("4", True, None)

        until(changed)
        wrong = {**rate, "name": "fields.vesc", "value": "sped"}

        def reason() -> str:
            told = answers.change(embedded.cloud, wrong)["settings"]
            assert "motion.stopped" not in {one["name"] for one in told}
            return told[-1]["reason"]

        assert "did you mean speed?" in until(reason)
        with pytest.raises(StationError, match="got 40; nothing is changed"):
            answers.change(embedded.cloud, {**rate, "value": "40"})
        ended = "command drive: nobody renews it, stopping"
        until(lambda: ended in recorded(LOG_STREAM, "text"))
        # Then its own driver drives on.
        until(lambda: recorded(VESC_STREAM, "speed")[-1] > 4614)
    speeds = recorded(VESC_STREAM, "speed")
    assert -1.2 < min(speeds) / 4614 < -0.8
    shown = iort("query", car.robot, LOG_STREAM, "--last", "5m", "--json")
    rows = [json.loads(line) for line in shown.output.splitlines() if line.startswith("{")]
    assert ended in [row.get("text") for row in rows], shown.output
