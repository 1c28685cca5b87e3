"""The rights of viewers and drivers: their roles' credentials, and addresses signed with them."""

from __future__ import annotations

from datetime import datetime, timezone
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import botocore.auth
import pytest
from botocore.credentials import ReadOnlyCredentials

from iort_contract.cloud import DRIVER, PUBNUB, VIEWER
from iort_station.errors import StationError
from iort_station.fleet import registry, roles
from iort_station.fleet.roles import Role, has_drivers, signed_url, transport
from iort_station.page.motion import everybody, reaching, socket_actions
from iort_station.page.page import config

BROKER = "wss://abc-ats.iot.eu-west-1.amazonaws.com/mqtt"
KEY = ReadOnlyCredentials("AKIA", "secret", "a/token+")


class Cloud:
    """A deployment without drivers, which counts the roles that were assumed."""

    namespace, region_name, websocket_url = "iort", "eu-west-1", BROKER

    def __init__(self, **outputs: str) -> None:
        self.outputs, self.assumed = outputs, 0

    websocket = None
    meta = SimpleNamespace(endpoint_url="")

    def urgent(self) -> Cloud:
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
    cloud: Any = Cloud(
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
    assert socket_actions(cloud).keys() == {"drive"}
    assert not socket_actions(Cloud())  # type: ignore[arg-type]  # a fake


def test_a_role_is_assumed_again_before_its_credentials_end(monkeypatch):
    now = [1_000.0]
    monkeypatch.setattr(roles.time, "time", lambda: now[0])
    # The machine sleeps for most of the hour.
    monkeypatch.setattr(roles.time, "monotonic", lambda: 1_000.0)
    cloud = Cloud(ViewerRole="arn:aws:iam::1:role/iort-fleet-Viewer")
    role = Role(cloud)  # type: ignore[arg-type]  # a fake
    assert role.signed().client_id != role.signed().client_id
    assert cloud.assumed == 1
    now[0] += 3_600 - 599
    assert role.credentials().token == "t2"


def test_a_deployment_without_drivers_says_how_to_get_them():
    cloud: Any = Cloud(ViewerRole="arn:aws:iam::1:role/iort-fleet-Viewer")
    assert not has_drivers(cloud)
    assert transport(cloud) == PUBNUB, "a deployment from before it could be chosen"
    with pytest.raises(StationError, match="no role for a driver: deploy -c drivers=true"):
        Role(cloud, DRIVER).credentials()
    assert Role(cloud, VIEWER).client_id().startswith("iort-viewer-")
