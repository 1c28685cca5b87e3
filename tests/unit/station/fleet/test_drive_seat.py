"""The emergency stop of `iort drive`: by the broker first, and a failure is told."""

from __future__ import annotations

from typing import Any

import pytest

from iort_contract.messages.control.commands import decode_command
from iort_contract.messages.control.driving import DriveLimits
from iort_station.cli.verbs.fleet.drive import _Seat
from iort_station.errors import StationError
from iort_station.fleet import stopping
from iort_station.fleet.driving import Driver, Phase

LIMITS = DriveLimits("drive", "drive.speed", "drive.steering_angle", 2.0, 0.4, 500)


class Cloud:
    namespace = "iort"

    def urgent(self) -> Cloud:
        return self


def test_the_emergency_stop_ends_the_hold_at_once_and_is_not_taken_for_done_if_it_fails(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(LIMITS, "anna", 1.0)
    seat: Any = _Seat(Cloud(), "car7", driver)  # type: ignore[arg-type]  # a fake
    sent: list[Any] = []
    seat.broker.publish = lambda topic, message: sent.append((topic, message))
    driver.phase, driver._held, driver._session = Phase.STARTING, True, "0badcafe"

    def stop(_cloud: Any, robots: list[str], *, by: str) -> dict[str, str]:
        assert by == "anna"
        assert decode_command(sent[-1][1]).ends
        return {robots[0]: "Throttling"}

    monkeypatch.setattr(stopping, "stop", stop)
    with pytest.raises(StationError, match="emergency stop of car7 has failed: Throttling"):
        seat._press("e", 1_000_000)
