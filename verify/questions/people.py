"""Who watches and drives: a viewer and a driver by AssumeRole, and everybody by an identity without a login,
each over a signed WebSocket."""

from __future__ import annotations

import base64
import http.client
import json
import secrets
from collections.abc import Callable
from contextlib import closing
from typing import Any
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from botocore.credentials import ReadOnlyCredentials

from iort_contract.catalog.streams import LOG_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import DRIVER, VIEWER
from iort_contract.messages.live import lease_topic
from iort_contract.topics import CMD, LIVE, build_topic
from iort_station.fleet.roles import Role
from iort_station.page import motion
from testkit.mqtt import STALE, WAIT_S, Person
from testkit.target import Target
from testkit.waiting import InstrumentError
from verify.question import CHANGED, Seen, question
from verify.tools import trust

_IOT = "https://docs.aws.amazon.com/iot/latest/developerguide"
_COGNITO = "https://docs.aws.amazon.com/cognito/latest/developerguide"
_ASSUMED = f"{_IOT}/iam-users-groups-roles.html and {_IOT}/protocols.html"
_RELIED = ("stacks/fleet.py", "station/iort_station/fleet/roles.py")
_HEARD, _SENT = "GRANTED_QOS_1", "SUCCESS"

Connect = Callable[[], Person]


def _may(connect: Connect, act: Callable[[Person], str]) -> str:
    """The answer to one attempt over a connection of its own, which a refusal may end."""
    with connect() as person:
        person.online()
        try:
            return act(person)
        except InstrumentError:
            if not person.lost.is_set():
                raise
            return "DISCONNECTED"


def _asked(target: Target, connect: Connect, robot: str) -> dict[str, Any]:
    """What may be heard of the robot, and what may be sent to it."""
    namespace = target.cloud.namespace
    vesc, log = (build_topic(LIVE, robot, stream, namespace) for stream in (VESC_STREAM, LOG_STREAM))
    view, command = lease_topic(robot, namespace), build_topic(CMD, robot, "drive", namespace)
    with connect() as person:
        subscribed, heard = person.online().subscribe(f"{LIVE}/{namespace}/{robot}/+"), list[str]()
        # By the broker's HTTP API, and in this order.
        for topic in (log, vesc):
            target.cloud.client("iot-data").publish(topic=topic, qos=1, payload=STALE)
        while vesc not in heard:
            heard.append(person.next_message()[0])
    codes = {
        "hears_cmd": _may(connect, lambda person: person.subscribe(command)),
        "sends_view": _may(connect, lambda person: person.attempt(view, b"{}")),
        "sends_cmd": _may(connect, lambda person: person.attempt(command, b"{}")),
    }
    return {
        "live": subscribed,
        "log_is_heard": log in heard,
        **{name: code in (_HEARD, _SENT) for name, code in codes.items()},
        "note_codes": codes,
    }


def _in_role(target: Target, name: str) -> Seen:
    role = Role(target.cloud, name)
    return _asked(
        target,
        lambda: Person(target.cloud, role.credentials(), role.client_id()),
        target.name("verify-watched"),
    )


@question(
    "people.viewer",
    expected={
        "live": _HEARD,
        "log_is_heard": True,
        "hears_cmd": False,
        "sends_view": True,
        "sends_cmd": False,
    },
    source=_ASSUMED,
    relied_on_by=_RELIED,
)
def viewer(target: Target) -> Seen:
    """With the credentials of the role viewer (AssumeRole), AWS IoT accepts a signed WebSocket, and asks the
    role alone: live messages and log are heard, a lease is sent, a command is refused."""
    return _in_role(target, VIEWER)


@question(
    "people.driver",
    expected={
        "live": _HEARD,
        "log_is_heard": True,
        "hears_cmd": False,
        "sends_view": True,
        "sends_cmd": True,
    },
    source=_ASSUMED,
    relied_on_by=_RELIED,
)
def driver(target: Target) -> Seen:
    """With the role driver also a command is sent."""
    return _in_role(target, DRIVER)


@question(
    "people.signed_address",
    expected={"signed": 101, "not_signed": 403},
    source=f"{_IOT}/iam-users-groups-roles.html",
    relied_on_by=("station/iort_station/fleet/roles.py", "station/web/src/link/socket_address.ts"),
)
def signed_address(target: Target) -> Seen:
    """A page's address is signed in its query, for the service iotdevicegateway. The session's token stands
    behind the signature, and is not signed. AWS IoT opens a WebSocket there, and none without a signature."""
    headers = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": base64.b64encode(secrets.token_bytes(16)).decode(),
        "Sec-WebSocket-Protocol": "mqtt",
    }

    def opened(url: str) -> int:
        address = urlsplit(url)
        kind = http.client.HTTPSConnection if address.scheme == "wss" else http.client.HTTPConnection
        with closing(kind(address.netloc, timeout=WAIT_S)) as connection:
            connection.request("GET", f"{address.path}?{address.query}", headers=headers)
            return connection.getresponse().status

    signed = Role(target.cloud, VIEWER).signed().url
    return {"signed": opened(signed), "not_signed": opened(target.cloud.websocket_url)}


@question(
    "people.everybody",
    expected={
        "live": _HEARD,
        "log_is_heard": False,
        "hears_cmd": False,
        "sends_view": False,
        "sends_cmd": False,
    },
    source=f"{_IOT}/cog-iot-policies.html and {_COGNITO}/iam-roles.html",
    phase=CHANGED,
    relied_on_by=("stacks/fleet.py", "station/web/src/link/socket_address.ts"),
)
def everybody(target: Target) -> Seen:
    """Amazon Cognito gives anybody an identity and credentials without a signature. With these a signed
    WebSocket hears the live messages of the page's robots: AWS IoT asks the identity's IAM role alone, and
    Cognito's session policies allow it, which AWS does not document. Log, commands and leases are refused."""
    identity = motion.identity(target.cloud)

    def cognito(action: str, **body: str) -> dict[str, Any]:
        """As the page asks."""
        headers = {
            "Content-Type": "application/x-amz-json-1.1",
            "X-Amz-Target": f"AWSCognitoIdentityService.{action}",
        }
        asked = Request(identity["endpoint"], json.dumps(body).encode(), headers)  # noqa: S310 - AWS' address
        with urlopen(asked, timeout=WAIT_S, context=trust(target)) as answer:  # noqa: S310 - AWS' address
            return dict(json.load(answer))

    found = cognito("GetId", IdentityPoolId=identity["pool"])
    got = cognito("GetCredentialsForIdentity", IdentityId=found["IdentityId"])["Credentials"]
    keys = ReadOnlyCredentials(got["AccessKeyId"], got["SecretKey"], got["SessionToken"])
    return _asked(
        target,
        lambda: Person(target.cloud, keys, f"{identity['client_prefix']}{secrets.token_hex(8)}"),
        next(iter(identity["robots"]), target.name("verify-watched")),
    )
