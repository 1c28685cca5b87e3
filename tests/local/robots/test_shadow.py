"""Runtime settings go from the operator to a running agent, and reports come back, on the embedded cloud."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from iort_contract.topics import SHADOW
from iort_station.operations import audit
from local.cloud import ROOT
from testkit.waiting import GUARD_S, until


@contextmanager
def driving(bundle: Any) -> Iterator[None]:
    command = [Path(sys.executable).parent / "iort-agent", "run", "--config", bundle.config]
    with subprocess.Popen(command, cwd=ROOT) as agent:
        try:
            yield
        finally:
            agent.terminate()
            assert agent.wait(GUARD_S) == 0


class Shadow:
    def __init__(self, embedded: Any, robot: str) -> None:
        self.data, self.robot = embedded.cloud.client("iot-data"), robot

    def request(self, **desired: Any) -> None:
        payload = json.dumps({"state": {"desired": desired}})
        self.data.update_thing_shadow(thingName=self.robot, shadowName=SHADOW, payload=payload)

    def reported(self) -> dict[str, Any]:
        try:
            answer = self.data.get_thing_shadow(thingName=self.robot, shadowName=SHADOW)
        except self.data.exceptions.ResourceNotFoundException:
            return {}
        found: dict[str, Any] = json.loads(answer["payload"].read())["state"].get("reported", {})
        return found


def test_settings_take_effect_and_invalid_ones_are_rejected_with_the_reason(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}])
    shadow = Shadow(embedded, car.robot)
    with driving(car):
        until(lambda: shadow.reported().get("live") == {"enabled": True, "rate_hz": 10, "when": "watched"})
        shadow.request(live={"rate_hz": 2}, fields={"vesc": ["speed", "voltage_input"]}, log_level="debug")
        until(lambda: shadow.reported().get("live") == {"enabled": True, "rate_hz": 2, "when": "watched"})
        assert shadow.reported()["fields"] == {"vesc": ["speed", "voltage_input"]}
        assert shadow.reported()["log_level"] == "debug"
        until(
            lambda: (
                {"speed", "voltage_input"}
                in [set(batch.columns) for batch in audit.batches(embedded.cloud, car.robot, "vesc")]
            )
        )
        shadow.request(live={"rate_hz": 50}, fields={"vesc": ["sped"]})
        until(lambda: len(shadow.reported().get("rejected", {})) == 2)
        rejected = shadow.reported()["rejected"]
        assert rejected["live.rate_hz"]["value"] == 50
        assert "from 0.01 to 10 (Hz)" in rejected["live.rate_hz"]["reason"]
        assert "did you mean speed?" in rejected["fields.vesc"]["reason"]
        # After a rejected setting the last accepted value stays; a valid setting clears the rejection.
        assert shadow.reported()["live"]["rate_hz"] == 2
        assert shadow.reported()["fields"] == {"vesc": ["speed", "voltage_input"]}
        shadow.request(live={"rate_hz": 10}, fields={"vesc": []})
        until(lambda: not shadow.reported().get("rejected"))
        assert not shadow.reported().get("fields")


def test_settings_made_while_the_agent_was_off_take_effect_at_its_start(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}])
    shadow = Shadow(embedded, car.robot)
    shadow.request(record={"enabled": False}, ping={"rate_hz": 5})
    with driving(car):
        until(lambda: shadow.reported().get("record") == {"enabled": False})
        shadow.request(record={"enabled": None})
        until(lambda: shadow.reported().get("record") == {"enabled": True})
        assert shadow.reported()["ping"] == {"rate_hz": 5}
        until(lambda: list(audit.batches(embedded.cloud, car.robot, "rtt")))
