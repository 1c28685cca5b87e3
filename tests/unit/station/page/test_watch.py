"""`iort watch` shows live updates."""

from __future__ import annotations

from typing import Any

from rich.console import Console

from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.limits import Value
from iort_contract.messages.live import LiveSample, live_update
from iort_station.page.live import GONE_S, MAX_ROBOTS, STALE_S, FleetWatch

NOW_US = 1_700_000_000_000_000


def update(robot: str = "car1", **sample: Value) -> dict[str, Any]:
    live = LiveSample("0badcafe", 0, NOW_US - 12_000, NOW_US - 10_000, sample)
    return live_update(robot, VESC_STREAM, live, NOW_US // 1000 - 6, NOW_US - 2_000)


def text(fleet: FleetWatch, width: int = 120, now_us: int = NOW_US) -> str:
    console = Console(width=width, file=None, record=True, quiet=False, force_terminal=False)
    with console.capture() as captured:
        console.print(fleet.table(now_us, width))
    return captured.get()


def test_every_car_is_shown_with_its_newest_values():
    fleet = FleetWatch({"car1": Vehicle(4614.0)})
    fleet.take(update(speed=9228, voltage_input=11.72, temperature_pcb=28.4, fault_code=0), 0, NOW_US)
    fleet.take(update("car10", speed=500), 0, NOW_US)
    fleet.take(update("car2", fault_code=5), 0, NOW_US)
    lines = text(fleet).splitlines()
    assert [line.split()[0] for line in lines] == ["car", "car1", "car2", "car10"]
    assert lines[1].split() == ["car1", "online", "2.0", "m/s", "11.7", "28", "10", "ms", "0.0", "s"]
    assert "MOSFET over-temperature (5)" in lines[2]
    assert "500 erpm" in lines[3]


def test_speed_uses_the_cars_gain_and_offset():
    fleet = FleetWatch({"car1": Vehicle(4614.0, 4614.0)})
    fleet.take(update(speed=9228), 0, NOW_US)
    assert "1.0 m/s" in text(fleet)


def test_a_car_becomes_stale_and_then_gone():
    fleet = FleetWatch({})
    fleet.take(update(speed=1), 0, NOW_US)
    (car,) = fleet.cars()
    states = [car.state(NOW_US + int(s * 1e6)) for s in (0, STALE_S + 0.1, GONE_S + 0.1)]
    assert states == ["online", "stale", "gone"]
    assert GONE_S < 5


def test_a_delayed_sample_is_stale():
    fleet = FleetWatch({})
    fleet.take(update(), 0, NOW_US + 2_000_000)
    assert fleet.cars()[0].state(NOW_US + 2_000_000) == "stale"


def test_the_delay_is_measured_on_the_clouds_clock():
    fleet = FleetWatch({})
    behind = update()
    behind["hops"] |= {"sent_us": NOW_US - 3_600_000_000, "offset_us": 3_600_000_000 - 10_000}
    behind["t"] = NOW_US - 3_600_002_000
    fleet.take(behind, 0, NOW_US)
    assert fleet.cars()[0].delay_ms == 10
    assert fleet.cars()[0].state(NOW_US) == "online"


def test_the_table_fits_a_narrow_terminal():
    fleet = FleetWatch({"car1": Vehicle(4614.0)})
    fleet.take(update(speed=9228, voltage_input=11.7, fault_code=5), 0, NOW_US)
    for width in (40, 60, 100):
        assert all(len(line) <= width for line in text(fleet, width).splitlines())
    assert "2.0 m/s" in text(fleet, 40)


def test_an_invalid_update_is_counted():
    fleet = FleetWatch({})
    good = update()
    bad: list[Any] = [7, None, [], {}, {**good, "v": 9}, {**good, "robot": "[red]x"}, {**good, "hops": {}}]
    bad += [{**good, "t": "1"}, {**good, "sample": 3}]
    for each in bad:
        fleet.take(each, 0, NOW_US)
    assert fleet.refused == len(bad)
    assert fleet.cars() == []


def test_the_number_of_robots_is_bounded():
    fleet = FleetWatch({})
    for i in range(MAX_ROBOTS + 3):
        fleet.take(update(f"car{i}"), 0, NOW_US + i)
    assert len(fleet.cars()) == MAX_ROBOTS
    assert fleet.cars()[0].robot == "car3"
