"""Least privilege of viewers, of drivers and of everybody on the web, at the broker with enforcement on."""

from __future__ import annotations

import asyncio
import threading
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import pytest
from awscrt import mqtt5
from awscrt.exceptions import AwsCrtError
from botocore import UNSIGNED
from botocore.config import Config
from botocore.credentials import ReadOnlyCredentials
from paho.mqtt import client as paho
from paho.mqtt.enums import CallbackAPIVersion
from yarl import URL

from iort_contract.messages.video import (
    OFFER,
    Look,
    answer_topic,
    decode_look,
    encode_look,
    look_topic,
    picture_topic,
)
from iort_contract.topics import LIVE, build_topic
from iort_station.errors import StationError
from iort_station.fleet import broker
from iort_station.fleet.broker import Broker
from iort_station.fleet.roles import Role, signed_url
from iort_station.page import motion
from testkit.mqtt import Person as Client
from testkit.mqtt import Robot
from testkit.waiting import GUARD_S
from tests.isolation import (
    CONNECT,
    DRIVER,
    EVERYBODY,
    ME,
    OTHER,
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


def test_two_viewers_of_a_robot_hear_only_their_own_answers(embedded, people, bundle):
    car = bundle()
    offer = encode_look(Look(ME, "0badcafe", OFFER, sdp="v=0"))
    answers = {ME: b"for me", OTHER: b"for another"}

    def viewer(who: str, name: str) -> Client:
        return Client(embedded.cloud, people[who].credentials(), f"iort-{who}-{name}")

    with (
        Robot(car.folder) as robot,
        viewer(VIEWER, ME) as mine,
        viewer(DRIVER, OTHER) as another,
    ):
        robot.online().subscribe(look_topic(car.robot, "iort"))
        for person, name in ((mine, ME), (another, OTHER)):
            person.online()
            for heard in (answer_topic(car.robot, name, "iort"), picture_topic(car.robot, "iort")):
                assert person.subscribe(heard) == "GRANTED_QOS_1"
        mine.publish(look_topic(car.robot, "iort"), offer)
        topic, asked = robot.next_message()
        assert (topic, decode_look(asked).viewer) == (look_topic(car.robot, "iort"), ME)
        for name, answer in answers.items():
            robot.publish(answer_topic(car.robot, name, "iort"), answer)
        robot.publish(picture_topic(car.robot, "iort"), b"picture")
        for person, name in ((mine, ME), (another, OTHER)):
            heard = [person.next_message() for _ in range(2)]
            assert heard == [
                (answer_topic(car.robot, name, "iort"), answers[name]),
                (picture_topic(car.robot, "iort"), b"picture"),
            ]


@pytest.mark.parametrize("size", [128 * 1024 + 1, 1_000_000])
def test_a_look_of_a_megabyte_ends_its_senders_session_alone(embedded, people, bundle, size):
    """A viewer that is no library of AWS: those refuse to send it."""
    car = bundle()
    url = urlsplit(people[VIEWER].signed().url)
    ended, connected = threading.Event(), threading.Event()
    hostile = paho.Client(
        CallbackAPIVersion.VERSION2, "iort-viewer-hostile", transport="websockets", protocol=paho.MQTTv311
    )
    hostile.ws_set_options(path=f"{url.path}?{url.query}")
    if url.scheme == "wss":
        hostile.tls_set(ca_certs=embedded.cloud.ca_bundle)
    hostile.on_connect = lambda *_: connected.set()
    hostile.on_disconnect = lambda *_: ended.set()
    with (
        Robot(car.folder) as robot,
        Client(embedded.cloud, people[VIEWER].credentials(), "iort-viewer-other") as other,
    ):
        other.online()
        robot.online().subscribe(look_topic(car.robot, "iort"))
        hostile.connect(url.hostname or "", url.port or 443)
        hostile.loop_start()
        try:
            assert connected.wait(GUARD_S)
            hostile.publish(look_topic(car.robot, "iort"), b"x" * size, qos=1)
            assert ended.wait(GUARD_S)
        finally:
            hostile.loop_stop()
        assert other.publish(look_topic(car.robot, "iort"), b"{}") == "SUCCESS"
        assert robot.next_message() == (look_topic(car.robot, "iort"), b"{}")


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
