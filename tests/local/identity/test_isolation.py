"""Least privilege on the broker with enforcement on: every row of the isolation table, and clients that may
not connect.
"""

from __future__ import annotations

import socket
import ssl
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from botocore.exceptions import ClientError
from ministack.services import iot

from iort_contract.limits import MAX_MESSAGE_BYTES
from iort_contract.messages.live import encode_ping
from iort_contract.topics import CMD, FLEET, PING, PONG, RULE, build_topic
from iort_station.fleet import identity, robots
from testkit.mqtt import Robot, payload_for
from testkit.waiting import InstrumentError
from tests.isolation import CLAIM, CONNECT, PUBLISH, RECEIVE, ROBOT, ROWS, SUBSCRIBE, A, B, Row

WAIT_S = 60
# The broker's answers to allowed requests.
ALLOWED = {"SUCCESS", "NO_MATCHING_SUBSCRIBERS", "GRANTED_QOS_0", "GRANTED_QOS_1"}


@pytest.fixture(scope="module")
def folders(embedded, tmp_path_factory):
    out = tmp_path_factory.mktemp("robots")
    folders = {name: robots.add(embedded.cloud, name, out=out).folder for name in (A, B)}
    folders[CLAIM] = out / "claim"
    identity.claim(embedded.cloud, None, out=folders[CLAIM], lasting=True)
    # The robots' own form of a folder.
    for name in ("certificate.pem", "private.key"):
        (folders[CLAIM] / f"claim-{name}").rename(folders[CLAIM] / name)
    (folders[CLAIM] / "car.yaml").write_text((folders[A] / "car.yaml").read_text())
    return folders


@pytest.fixture(scope="module")
def robot_a(folders):
    with Robot(folders[A]) as robot:
        yield robot.online()


class Session:
    """A client that reconnects after the broker disconnects it for a forbidden request."""

    def __init__(self, folder: Path, client_id: str) -> None:
        self._new: Callable[[], Robot] = lambda: Robot(folder, client_id=client_id)
        self._robot: Robot | None = None

    def attempt(self, row: Row) -> bool:
        """Return whether the broker allowed it; a session that ends was denied."""
        if self._robot is None:
            self._robot = self._new()
            self._robot.__enter__()
            self._robot.online()
        try:
            said = (
                self._robot.publish(row.what, payload_for(row.what))
                if row.does == PUBLISH
                else self._robot.subscribe(row.what)
            )
        except InstrumentError:
            # The library's error only reports a missing answer; the lost connection shows the denial.
            assert self._robot.lost.wait(WAIT_S), row
            said = "LOST"
        if self._robot.lost.is_set():
            self.close()
        return said in ALLOWED

    def close(self) -> None:
        if self._robot is not None:
            self._robot.__exit__()
            self._robot = None


@contextmanager
def session(folder: Path, client_id: str) -> Iterator[Session]:
    opened = Session(folder, client_id)
    try:
        yield opened
    finally:
        opened.close()


def rows(who: str, does: str) -> list[Row]:
    return [row for row in ROWS if (row.who, row.does) == (who, does)]


@pytest.mark.parametrize("does", [PUBLISH, SUBSCRIBE])
@pytest.mark.parametrize(("who", "client"), [(ROBOT, A), (CLAIM, "iort-claim-1")])
def test_the_broker_follows_the_isolation_table(folders, who, client, does):
    with session(folders[A if who == ROBOT else CLAIM], client) as tried:
        told = [(row.what, tried.attempt(row), row.allowed) for row in rows(who, does)]
    assert [one for one in told if one[1] != one[2]] == []


@pytest.mark.parametrize("who", [ROBOT, CLAIM])
def test_a_client_can_connect_only_under_its_own_id(folders, who):
    for row in rows(who, CONNECT):
        with Robot(folders[A if who == ROBOT else CLAIM], client_id=row.what) as robot:
            if row.allowed:
                robot.online()
            else:
                assert robot.refused.wait(WAIT_S), row
                assert not robot.connected.is_set(), row


def test_a_robot_receives_only_allowed_messages(embedded, folders):
    """Messages to others do not reach it, whatever it subscribes to."""
    said = [row for row in rows(ROBOT, RECEIVE) if not row.what.startswith("$")]
    data, last = embedded.cloud.client("iot-data"), build_topic(CMD, A, "last")
    with Robot(folders[A]) as robot:
        robot.online()
        for row in rows(ROBOT, SUBSCRIBE):
            if row.allowed:
                robot.subscribe(row.what)
        for row in said:
            data.publish(topic=row.what, qos=1, payload=payload_for(row.what))
        data.publish(topic=last, qos=1, payload=b"{}")
        heard = set()
        while last not in heard:
            heard.add(robot.next_message()[0])
    assert heard == {row.what for row in said if row.allowed} | {last}


# --- clients that may not connect -------------------------------------------------------------------


def test_a_client_without_a_certificate_cannot_connect(embedded):
    context = ssl.create_default_context(cadata=embedded.cloud.root_ca_pem)
    context.check_hostname = False
    connect = b"\x10\x11\x00\x04MQTT\x04\x02\x00\x3c\x00\x05thief"
    address = (embedded.cloud.mqtt_host, embedded.cloud.mqtt_port)
    with socket.create_connection(address, timeout=WAIT_S) as raw:
        try:
            with context.wrap_socket(raw) as client:
                client.sendall(connect)
                answer = client.recv(16)
        except OSError:
            answer = b""
    assert answer == b"", "AWS ends the handshake"


@pytest.mark.parametrize("change", ["REVOKED", "INACTIVE", "no thing", "no policy", "removed"])
def test_a_robot_without_all_that_belongs_to_it_cannot_connect(embedded, bundle, change):
    car, iot = bundle(), embedded.cloud.client("iot")
    (arn,) = iot.list_thing_principals(thingName=car.robot)["principals"]
    if change == "no thing":
        iot.detach_thing_principal(thingName=car.robot, principal=arn)
    elif change == "no policy":
        iot.detach_policy(policyName="iort-robot", target=arn)
    elif change == "removed":
        robots.remove(embedded.cloud, car.robot)
    else:
        iot.update_certificate(certificateId=arn.rsplit("/", 1)[-1], newStatus=change)
    refused(car.folder)


def refused(folder: Path) -> None:
    with Robot(folder) as robot:
        assert robot.refused.wait(WAIT_S)
        assert not robot.connected.is_set()


# --- robots among themselves ------------------------------------------------------------------------


def test_robots_talk_to_each_other_over_the_broker(folders, robot_a):
    with Robot(folders[B]) as robot_b:
        assert robot_b.online().subscribe(f"{FLEET}/iort/+/#") == "GRANTED_QOS_1"
        robot_a.publish(build_topic(FLEET, A, "pose"), b'{"x": 1}')
        assert robot_b.next_message() == (build_topic(FLEET, A, "pose"), b'{"x": 1}')


def test_a_rule_republishes_to_the_sender(folders, robot_a):
    robot_a.subscribe(f"{PONG}/iort/{A}/+")
    with Robot(folders[B]) as robot_b:
        robot_b.online().subscribe(f"{PONG}/iort/{B}/+")
        robot_b.publish(build_topic(PING, B, RULE), encode_ping(7, 1))
        topic, payload = robot_b.next_message()
    assert topic == build_topic(PONG, B, RULE)
    assert b'"id": 7' in payload
    heard_by_a = [robot_a.messages.get_nowait()[0] for _ in range(robot_a.messages.qsize())]
    assert not [topic for topic in heard_by_a if topic.startswith(PONG)]


def test_the_largest_message_is_accepted(folders):
    with Robot(folders[B]) as robot:
        assert robot.online().publish(build_topic(FLEET, B, "image"), b"x" * MAX_MESSAGE_BYTES) == "SUCCESS"


def test_a_message_above_128_kb_is_rejected(embedded):
    data, topic = embedded.cloud.client("iot-data"), build_topic(FLEET, B, "image")
    data.publish(topic=topic, payload=b"x" * iot._MAX_PAYLOAD_BYTES)
    with pytest.raises(ClientError):
        data.publish(topic=topic, payload=b"x" * (iot._MAX_PAYLOAD_BYTES + 1))
