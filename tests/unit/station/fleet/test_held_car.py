"""The terminal's driver and the simulated car's own, with the agent's commands between them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from iort_contract.messages.control.commands import encode_command
from iort_contract.messages.live import LiveSample
from iort_station.fleet.driving import Driver as TerminalDriver
from iort_station.fleet.driving import Stick
from tests.unit.agent.sources.test_sim import CAR_LIMITS, Commanded


def test_a_driver_who_has_let_go_holds_the_car_and_leaves_it_to_its_own_driver_with_the_wheel() -> None:
    car, driver = Commanded(), TerminalDriver(CAR_LIMITS, "anna", 1.0)
    speeds: list[float] = []

    def drive(seconds: float) -> list[float]:
        """The car hears the driver's commands, and its answers come back at once."""
        before = len(speeds)
        for _ in range(round(seconds * 20)):
            now_us = car.rig.clock.now_us()
            heard = LiveSample("0badcafe", 0, now_us, now_us, {}, offset_us=0)
            driver.hear("vesc", heard, now_us)
            if (command := driver.tick(now_us)) is not None:
                car.rig.send(None, name="drive", raw=encode_command(command))
                driver.hear("drive", replace(heard, sample=dict(car.rig.drove[-1])), now_us)
            speeds.extend(speed for speed, _ in car.drive(0.06))
        return speeds[before:]

    drive(2)
    driver.stick = Stick(1.0, 0.0)
    driver.hold(held=True, now_us=car.rig.clock.now_us())
    assert drive(3)[-1] == pytest.approx(1.0, abs=0.03)
    driver.hold(held=False, now_us=car.rig.clock.now_us())
    assert set(drive(30)[150:]) == {0.0}, "it stands as long as the driver has the wheel"
    driver.leave()
    assert drive(10)[-1] > 1, "its own driver drives again"
