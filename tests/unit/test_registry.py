"""What the registry says of the cars."""

from __future__ import annotations

from decimal import Decimal

from station import registry
from tests.fakes import ROBOTS, serialize
from tests.unit.test_station_data import cloud_of


def test_presence_says_since_when():
    cloud = cloud_of(robot="new")
    rows = [
        {"robot": "on", "online": True, "connected_ms": Decimal(2000), "disconnected_ms": Decimal(1000)},
        {"robot": "off", "online": False, "connected_ms": Decimal(2000), "disconnected_ms": Decimal(3000)},
    ]
    for row in rows:
        cloud.table.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
    assert registry.presence(cloud) == {
        "new": {"online": False, "since_ms": None},
        "on": {"online": True, "since_ms": 2000},
        "off": {"online": False, "since_ms": 3000},
    }


def test_vehicles_have_what_speed_is_derived_with():
    cloud = cloud_of(robot="plain", gain="4614")
    rows = [
        {"robot": "shifted", "speed_to_erpm_gain": Decimal(4000), "speed_to_erpm_offset": Decimal("12.5")},
        {"robot": "unknown"},
    ]
    for row in rows:
        cloud.table.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
    assert registry.vehicles(cloud) == {
        "plain": {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 0.0},
        "shifted": {"speed_to_erpm_gain": 4000.0, "speed_to_erpm_offset": 12.5},
    }
