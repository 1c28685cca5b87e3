"""The registry's rows of the cars."""

from __future__ import annotations

from decimal import Decimal

import pytest

from iort_agent.config import load_config
from iort_contract.catalog.derived import Vehicle, registered_vehicle
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry
from iort_station.fleet.identity import Bundle, write_bundle
from testkit.dynamodb import ROBOTS, serialize
from tests.unit.station.data.test_data import FakeCloud, cloud_of


def test_presence_has_its_start_time():
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


def test_vehicles_have_their_gain_and_offset():
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


@pytest.mark.parametrize("name", ["iort-viewer-1", "iort-driver-car", "iort-claim-1"])
def test_a_robot_has_no_name_under_which_others_connect(dynamodb, name):
    cloud = FakeCloud(dynamodb)
    with pytest.raises(StationError, match="must not begin with iort-claim-, iort-viewer-, iort-driver-"):
        registry.enter(cloud, name, {})
    registry.enter(cloud, "iort-viewer", {})


def test_a_gain_that_somebody_gave_is_told_from_the_default(dynamodb):
    cloud = FakeCloud(dynamodb)
    for robot in ("default", "own"):
        registry.enter(cloud, robot, registry.F1TENTH)
    registry.set_vehicle(cloud, "own", registry.given({"speed_to_erpm_gain": 4614.0}))
    registry.set_vehicle(cloud, "default", registry.given({"mass_kg": 3.5}))

    own = {robot: registered_vehicle(registry.get(cloud, robot)) for robot in ("default", "own")}

    assert own == {"default": None, "own": Vehicle(4614.0)}
    # The page goes on to show speeds with either.
    assert registry.vehicles(cloud).keys() == own.keys()


def test_set_vehicle_changes_only_the_given_parameters(dynamodb):
    cloud = FakeCloud(dynamodb)
    registry.enter(cloud, "car", {"speed_to_erpm_gain": 4614.0, "serial": "s"})
    assert registry.set_vehicle(cloud, "car", {"speed_to_erpm_gain": 1060.5}) == {"speed_to_erpm_gain": 4614}
    assert registry.set_vehicle(cloud, "car", {"speed_to_erpm_offset": -1e-05}) == {}
    assert registry.get(cloud, "car") == {
        "robot": "car",
        "serial": "s",
        "speed_to_erpm_gain": Decimal("1060.5"),
        "speed_to_erpm_offset": Decimal("-0.00001"),
    }
    with pytest.raises(StationError, match="robot nobody is not registered"):
        registry.set_vehicle(cloud, "nobody", {"speed_to_erpm_gain": 1.0})
    assert registry.find(cloud, "nobody") is None


@pytest.mark.parametrize(
    ("settings", "moves"),
    [
        ({}, True),
        # A bag, or a VESC without ROS, takes no commands.
        ({"sources": [{"type": "vesc", "port": "/dev/null"}]}, False),
        ({"downlink": {}}, False),
    ],
)
def test_a_written_configuration_has_the_motion_command_of_its_source(tmp_path, settings, moves):
    cloud = Cloud(mqtt_host="localhost", root_ca_pem="ca")
    bundle = Bundle("car7", tmp_path)
    write_bundle(cloud, bundle, "certificate", "key", settings)
    downlink = load_config(bundle.config).downlink
    assert downlink.moves() is moves
    assert (downlink.drive_limits() is not None) is moves
