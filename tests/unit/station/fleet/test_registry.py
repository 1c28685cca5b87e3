"""The registry of robots, and the rights of viewers and drivers at the broker."""

from __future__ import annotations

from concurrent.futures import Future
from datetime import datetime, timezone
from decimal import Decimal
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import botocore.auth
import pytest
from awscrt import mqtt5
from botocore.credentials import ReadOnlyCredentials

from iort_agent.config import load_config
from iort_contract.catalog.derived import Vehicle, registered_vehicle
from iort_contract.cloud import DRIVER, PUBNUB, VIEWER
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry, roles
from iort_station.fleet.broker import Broker
from iort_station.fleet.identity import Bundle, write_bundle
from iort_station.fleet.roles import Role, has_drivers, signed_url, transport
from iort_station.page.answers import keyed_actions
from iort_station.page.motion import everybody, reaching
from iort_station.page.page import config
from testkit.dynamodb import ROBOTS, serialize
from tests.unit.station.data.test_queries import FakeCloud, cloud_of


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


BROKER = "wss://abc-ats.iot.eu-west-1.amazonaws.com/mqtt"
KEY = ReadOnlyCredentials("AKIA", "secret", "a/token+")


class RoleCloud:
    """A deployment without drivers, which counts the roles that were assumed."""

    namespace, region_name, websocket_url = "iort", "eu-west-1", BROKER

    def __init__(self, **outputs: str) -> None:
        self.outputs, self.assumed = outputs, 0

    websocket = None
    meta = SimpleNamespace(endpoint_url="")

    def urgent(self) -> RoleCloud:
        return self

    def output(self, _noun: str, name: str) -> str:
        return self.outputs[name]

    def find_output(self, _noun: str, name: str) -> str | None:
        return self.outputs.get(name)

    def client(self, _service: str) -> Any:
        return self

    def assume_role(self, **_asked: Any) -> Any:
        self.assumed += 1
        key = {"AccessKeyId": "ASIA", "SecretAccessKey": "s", "SessionToken": f"t{self.assumed}"}
        return {"Credentials": key}


def test_the_token_follows_the_signature_and_is_not_in_it(monkeypatch):
    monkeypatch.setattr(
        botocore.auth, "get_current_datetime", lambda: datetime(2026, 11, 22, tzinfo=timezone.utc)
    )
    signed = signed_url(BROKER, KEY, region="eu-west-1")
    assert signed.startswith(f"{BROKER}?")
    assert signed.endswith("&X-Amz-Security-Token=a%2Ftoken%2B")
    asked = parse_qs(urlsplit(signed).query)
    assert asked["X-Amz-SignedHeaders"] == ["host"]
    assert asked["X-Amz-Credential"][0].endswith("/eu-west-1/iotdevicegateway/aws4_request")
    others = [KEY._replace(token="other"), KEY._replace(token=None), KEY._replace(secret_key="other")]
    same = [_signature(signed_url(BROKER, key, region="eu-west-1")) for key in others]
    assert [one == asked["X-Amz-Signature"][0] for one in same] == [True, True, False]


def _signature(url: str) -> str:
    return parse_qs(urlsplit(url).query)["X-Amz-Signature"][0]


def test_a_page_is_told_where_it_listens_and_may_connect_there(monkeypatch):
    monkeypatch.setattr(registry, "vehicles", lambda _: {"car1": {}, "hidden": {}})
    cloud: Any = RoleCloud(
        LiveTransport="iot", DriverRole="d", PublicPoolId="eu-west-1:1", PublicRobots="car1,car2"
    )
    told = everybody(cloud)
    assert told["live"] == "iot"
    assert told["identity"] | {"endpoint": ""} == {
        "pool": "eu-west-1:1",
        "region": "eu-west-1",
        "endpoint": "",
        "socket": BROKER,
        "client_prefix": "iort-viewer-",
        "robots": ["car1", "car2"],
    }
    assert "sub-c-" not in str(config(namespace="iort", **told))
    assert told["vehicles"] == {"car1": {}}, "nobody is told of a car that the site does not show"
    assert reaching(cloud, "iot") == {"live": "iot", "broker": "wss://abc-ats.iot.eu-west-1.amazonaws.com"}
    with pytest.raises(StationError, match="sends nothing to PubNub"):
        reaching(cloud, "pubnub")
    assert "drive" in keyed_actions(cloud)
    assert "drive" not in keyed_actions(RoleCloud())  # type: ignore[arg-type]  # a fake


def test_a_role_is_assumed_again_before_its_credentials_end(monkeypatch):
    now = [1_000.0]
    monkeypatch.setattr(roles.time, "time", lambda: now[0])
    # The machine sleeps for most of the hour.
    monkeypatch.setattr(roles.time, "monotonic", lambda: 1_000.0)
    cloud = RoleCloud(ViewerRole="arn:aws:iam::1:role/iort-fleet-Viewer")
    role = Role(cloud)  # type: ignore[arg-type]  # a fake
    assert role.signed().client_id != role.signed().client_id
    assert cloud.assumed == 1
    now[0] += 3_600 - 599
    assert role.credentials().token == "t2"


def test_a_deployment_without_drivers_says_how_to_get_them():
    cloud: Any = RoleCloud(ViewerRole="arn:aws:iam::1:role/iort-fleet-Viewer")
    assert not has_drivers(cloud)
    assert transport(cloud) == PUBNUB, "a deployment from before it could be chosen"
    with pytest.raises(StationError, match="no role for a driver: deploy -c drivers=true"):
        Role(cloud, DRIVER).credentials()
    assert Role(cloud, VIEWER).client_id().startswith("iort-viewer-")


def answered(*codes: mqtt5.SubackReasonCode) -> Future[Any]:
    """The broker's answer to a subscription."""
    answer: Future[Any] = Future()
    answer.set_result(SimpleNamespace(reason_codes=list(codes)))
    return answer


def test_a_subscription_that_is_refused_after_a_lost_connection_ends_the_drive() -> None:
    sent: list[Any] = []
    role: Any = SimpleNamespace(name="driver")
    broker = Broker(role, role, filters=["live/iort/car7/+"])
    broker._client = SimpleNamespace(publish=sent.append)  # type: ignore[assignment]  # a fake
    broker._subscribed(answered(mqtt5.SubackReasonCode.GRANTED_QOS_0))
    broker.publish("cmd/iort/car7/drive", b"{}")
    broker._subscribed(answered(mqtt5.SubackReasonCode.NOT_AUTHORIZED))
    with pytest.raises(StationError, match="refuses a driver: its subscription is refused"):
        broker.publish("cmd/iort/car7/drive", b"{}")
    assert len(sent) == 1
    broker._subscribed(answered(mqtt5.SubackReasonCode.GRANTED_QOS_0))
    broker.publish("cmd/iort/car7/drive", b"{}")
