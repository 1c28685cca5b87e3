"""Runtime settings go from the operator to a running agent, and reports come back, on the embedded cloud."""

from __future__ import annotations

import json
from typing import Any

from iort_contract.topics import SHADOW
from iort_station.operations import audit
from testkit.waiting import until
from tests.local.data.drives import Agent


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


def test_settings_made_while_the_agent_was_off_take_effect_at_its_start(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}])
    shadow = Shadow(embedded, car.robot)
    shadow.request(record={"enabled": False}, ping={"rate_hz": 5})
    with Agent(car):
        until(lambda: shadow.reported().get("record") == {"enabled": False})
        shadow.request(record={"enabled": None})
        until(lambda: shadow.reported().get("record") == {"enabled": True})
        assert shadow.reported()["ping"] == {"rate_hz": 5}
        until(lambda: list(audit.batches(embedded.cloud, car.robot, "rtt")))
