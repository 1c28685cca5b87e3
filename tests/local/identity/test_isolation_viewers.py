"""Least privilege of viewers, of drivers and of everybody on the web, at the broker with enforcement on."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import aiohttp
import pytest
from awscrt import mqtt5
from awscrt.exceptions import AwsCrtError
from botocore import UNSIGNED
from botocore.config import Config
from botocore.credentials import ReadOnlyCredentials
from yarl import URL

from iort_contract.topics import LIVE, build_topic
from iort_station.errors import StationError
from iort_station.fleet import broker
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role, signed_url
from iort_station.page import motion
from testkit.waiting import GUARD_S
from tests.isolation import (
    CONNECT,
    DRIVER,
    EVERYBODY,
    PUBLISH,
    RECEIVE,
    ROWS,
    SUBSCRIBE,
    VIEWER,
    Row,
)

PEOPLE = (VIEWER, DRIVER, EVERYBODY)


class Person(Role):
    """A role, with a client id of the test's choice."""

    as_client = ""

    def client_id(self) -> str:
        return self.as_client or super().client_id()


class Everybody(Person):
    """The credentials that Amazon Cognito gives to anybody."""

    def _assume(self) -> ReadOnlyCredentials:
        cloud = self._cloud
        cognito = cloud._session.client(
            "cognito-identity",
            endpoint_url=cloud.endpoint_url,
            verify=cloud.ca_bundle,
            config=Config(signature_version=UNSIGNED),
        )
        identity = cognito.get_id(IdentityPoolId=motion.identity(cloud)["pool"])["IdentityId"]
        got = cognito.get_credentials_for_identity(IdentityId=identity)["Credentials"]
        return ReadOnlyCredentials(got["AccessKeyId"], got["SecretKey"], got["SessionToken"])


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A slow answer is no refusal."""
    monkeypatch.setattr(broker, "_CONNECT_S", GUARD_S)


@pytest.fixture(scope="module")
def people(embedded):
    cloud = embedded.cloud
    return {VIEWER: Person(cloud, VIEWER), DRIVER: Person(cloud, DRIVER), EVERYBODY: Everybody(cloud)}


def may(cloud: Any, person: Person, row: Row) -> bool:
    person.as_client = row.what if row.does == CONNECT else ""
    try:
        with Broker(cloud, person, filters=[row.what] if row.does == SUBSCRIBE else []) as connected:
            if row.does != PUBLISH:
                return True
            packet = mqtt5.PublishPacket(topic=row.what, payload=b"{}", qos=mqtt5.QoS.AT_LEAST_ONCE)
            answer = connected._client.publish(packet).result(GUARD_S).puback
            return bool(answer.reason_code < mqtt5.PubackReasonCode.UNSPECIFIED_ERROR)
    except StationError:
        return False
    except AwsCrtError:
        # The broker ends the connection of a forbidden message.
        return False


@pytest.mark.parametrize("does", [CONNECT, PUBLISH, SUBSCRIBE])
@pytest.mark.parametrize("who", PEOPLE)
def test_the_isolation_table_holds_at_the_broker(embedded, people, who, does):
    rows = [row for row in ROWS if (row.who, row.does) == (who, does)]
    told = [(row.what, may(embedded.cloud, people[who], row), row.allowed) for row in rows]
    assert [one for one in told if one[1] != one[2]] == []


@pytest.mark.parametrize("who", PEOPLE)
def test_whoever_watches_hears_live_messages_and_no_other(embedded, people, who):
    data, heard, ended = embedded.cloud.client("iot-data"), set(), threading.Event()
    last = build_topic(LIVE, "last", "vesc")

    def hear(topic: str, _message: bytes) -> None:
        heard.add(topic)
        if topic == last:
            ended.set()

    people[who].as_client = ""
    rows = [row for row in ROWS if (row.who, row.does) == (who, RECEIVE)]
    filters = [row.what for row in ROWS if (row.who, row.does, row.allowed) == (who, SUBSCRIBE, True)]
    with Broker(embedded.cloud, people[who], filters=filters, on_message=hear):
        for topic in (*(row.what for row in rows), last):
            data.publish(topic=topic, qos=1, payload=b"{}")
        assert ended.wait(GUARD_S)
    assert heard == {row.what for row in rows if row.allowed} | {last}


def test_a_connection_without_a_valid_signature_is_refused(embedded, people):
    cloud = embedded.cloud
    good = people[VIEWER].credentials()
    region = cloud.region_name
    addresses = {
        "unsigned": cloud.websocket_url,
        "signed": signed_url(cloud.websocket_url, good, region=region),
        "another key": signed_url(cloud.websocket_url, good._replace(secret_key="x"), region=region),
        "another token": signed_url(cloud.websocket_url, good._replace(token="x"), region=region),
        "another region": signed_url(cloud.websocket_url, good, region="us-east-1").replace(
            "us-east-1", region
        ),
    }

    async def opened(url: str) -> bool:
        async with aiohttp.ClientSession() as session:
            try:
                async with session.ws_connect(URL(url, encoded=True), protocols=["mqtt"]):
                    return True
            except aiohttp.WSServerHandshakeError as refused:
                return refused.status != 403

    assert {name for name, url in addresses.items() if asyncio.run(opened(url))} == {"signed"}
