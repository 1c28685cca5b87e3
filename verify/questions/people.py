"""Who watches and drives: a viewer and a driver by AssumeRole, and everybody by an identity without a login,
each over a signed WebSocket."""

from __future__ import annotations

import base64
import http.client
import json
import secrets
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from botocore.credentials import ReadOnlyCredentials

from iort_agent.files.upload import trusting
from iort_agent.video.offers import of_deployment
from iort_contract.catalog.streams import LOG_STREAM
from iort_contract.cloud import DRIVER, VIEWER
from iort_contract.messages.live import lease_topic
from iort_contract.messages.video import answer_topic, look_topic
from iort_contract.topics import CMD, LIVE
from iort_station.fleet.relays import Relays
from iort_station.fleet.roles import Role
from iort_station.page import motion
from testkit.mqtt import STALE, WAIT_S, Person
from testkit.waiting import InstrumentError
from verify.lab import CannotAskError, Lab
from verify.question import CHANGED, Seen, question

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


def _rights(lab: Lab, connect: Connect, robot: str) -> dict[str, Any]:
    """What may be heard of the robot, and what may be sent to it."""
    vesc, log, command = (
        lab.topic(LIVE, robot),
        lab.topic(LIVE, robot, LOG_STREAM),
        lab.topic(CMD, robot, "drive"),
    )
    view, heard = lease_topic(robot, lab.namespace), list[str]()
    look, answer = look_topic(robot, lab.namespace), answer_topic(robot, "0badcafe", lab.namespace)
    with connect() as person:
        subscribed = person.online().subscribe(f"{LIVE}/{lab.namespace}/{robot}/+")
        # By the broker's HTTP API, and in this order.
        for topic in (log, vesc):
            lab.client("iot-data").publish(topic=topic, qos=1, payload=STALE)
        while vesc not in heard:
            heard.append(person.next_message()[0])
    codes = {
        "hears_cmd": _may(connect, lambda person: person.subscribe(command)),
        "sends_view": _may(connect, lambda person: person.attempt(view, b"{}")),
        "sends_cmd": _may(connect, lambda person: person.attempt(command, b"{}")),
        "sends_look": _may(connect, lambda person: person.attempt(look, b"{}")),
        "hears_looks": _may(connect, lambda person: person.subscribe(look)),
        "hears_an_answer": _may(connect, lambda person: person.subscribe(answer)),
        "sends_an_answer": _may(connect, lambda person: person.attempt(answer, b"{}")),
    }
    rights = {name: code in (_HEARD, _SENT) for name, code in codes.items()}
    return {"live": subscribed, "log_is_heard": log in heard, **rights, "note_codes": codes}


def _in_role(lab: Lab, name: str) -> Seen:
    role = Role(lab.cloud, name)

    def connect() -> Person:
        return Person(lab.cloud, role.credentials(), role.client_id())

    return _rights(lab, connect, lab.name("verify-watched"))


def _expected(*, log: bool, view: bool, command: bool) -> Seen:
    return {
        "live": _HEARD,
        "log_is_heard": log,
        "hears_cmd": False,
        "sends_view": view,
        "sends_cmd": command,
        "sends_look": view,
        "hears_looks": False,
        "hears_an_answer": view,
        "sends_an_answer": False,
    }


@question(
    "people.viewer",
    aws="iot:iam-users-groups-roles iot:protocols",
    expected=_expected(log=True, view=True, command=False),
)
def viewer(lab: Lab) -> Seen:
    """With the credentials of the role viewer (AssumeRole), AWS IoT accepts a signed WebSocket, and asks the
    role alone: live messages and log are heard, a lease is sent, a command is refused. For video it
    sends requests and hears the answers to a name that it knows; it hears no other viewer's requests, and
    answers none."""
    return _in_role(lab, VIEWER)


@question(
    "people.driver",
    aws="iot:iam-users-groups-roles iot:protocols",
    expected=_expected(log=True, view=True, command=True),
)
def driver(lab: Lab) -> Seen:
    """With the role driver also a command is sent."""
    return _in_role(lab, DRIVER)


@question(
    "people.signed_address",
    aws="iot:iam-users-groups-roles",
    expected={"signed": 101, "not_signed": 403},
)
def signed_address(lab: Lab) -> Seen:
    """A page's address is signed in its query, for the service iotdevicegateway. The session's token stands
    behind the signature, and is not signed. AWS IoT opens a WebSocket there, and none without a signature."""
    headers = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": base64.b64encode(secrets.token_bytes(16)).decode(),
        "Sec-WebSocket-Protocol": "mqtt",
    }

    def status(url: str) -> int:
        address = urlsplit(url)
        kind = http.client.HTTPSConnection if address.scheme == "wss" else http.client.HTTPConnection
        with closing(kind(address.netloc, timeout=WAIT_S)) as connection:
            connection.request("GET", f"{address.path}?{address.query}", headers=headers)
            return connection.getresponse().status

    signed = Role(lab.cloud, VIEWER).signed().url
    return {"signed": status(signed), "not_signed": status(lab.cloud.websocket_url)}


@question(
    "people.everybody",
    aws="iot:cog-iot-policies cognito:iam-roles",
    phase=CHANGED,
    expected=_expected(log=False, view=False, command=False),
)
def everybody(lab: Lab) -> Seen:
    """Amazon Cognito gives anybody an identity and credentials without a signature. With these a signed
    WebSocket hears the live messages of the page's robots: AWS IoT asks the identity's IAM role alone, and
    Cognito's session policies allow it, which AWS does not document. Log, commands, leases and
    video are refused."""
    identity, bundle = motion.identity(lab.cloud), lab.cloud.ca_bundle

    def cognito(action: str, **body: str) -> dict[str, Any]:
        """As the page asks."""
        headers = {
            "Content-Type": "application/x-amz-json-1.1",
            "X-Amz-Target": f"AWSCognitoIdentityService.{action}",
        }
        request = Request(identity["endpoint"], json.dumps(body).encode(), headers)  # noqa: S310 - AWS' address
        context = trusting(Path(bundle) if bundle else None)
        with urlopen(request, timeout=WAIT_S, context=context) as answer:  # noqa: S310 - AWS' address
            return dict(json.load(answer))

    person = cognito("GetId", IdentityPoolId=identity["pool"])
    answer = cognito("GetCredentialsForIdentity", IdentityId=person["IdentityId"])["Credentials"]
    keys = ReadOnlyCredentials(answer["AccessKeyId"], answer["SecretKey"], answer["SessionToken"])
    return _rights(
        lab,
        lambda: Person(lab.cloud, keys, f"{identity['client_prefix']}{secrets.token_hex(8)}"),
        next(iter(identity["robots"]), lab.name("verify-watched")),
    )


@question(
    "people.relays",
    aws="kvs:API_signaling_GetIceServerConfig kvs:API_signaling_IceServer webrtc:kvswebrtc-limits",
    phase=CHANGED,
    expected={"kinds": ["stun", "turn", "turns"], "robots_take_them": True, "kept": True},
    not_embedded="the embedded cloud has no relays",
)
def relays(lab: Lab) -> Seen:
    """CloudFormation makes a signalling channel without a name. With the role viewer,
    GetSignalingChannelEndpoint and GetIceServerConfig give TURN servers of the service's domain, which robots
    take from a viewer, with credentials that are good for over a minute; the STUN server has the same
    domain."""
    if lab.cloud.find_output("fleet", "TurnChannel") is None:
        raise CannotAskError("the deployment has no relays: deploy -c turn=true")
    asked = Relays(lab.cloud)
    servers = asked.servers()
    return {
        "kinds": sorted({url.partition(":")[0] for server in servers for url in server.urls}),
        "robots_take_them": of_deployment(servers) == tuple(servers),
        "kept": asked.servers() is servers,
    }
