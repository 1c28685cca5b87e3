"""One table of permissions: (who, action, resource, allowed).

tests/local/identity/test_isolation.py tries every row on the embedded cloud with enforcement on, and
tests/stacks/test_isolation.py asks the synthesized policies. roles.py there declares the
permissions of each role, and test_policies.py that no role has others.
"""

from __future__ import annotations

from typing import NamedTuple

from iort_contract.catalog.questions import CALIBRATION
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.streams import DRIVE_STREAM, LOG_STREAM
from iort_contract.cloud import claim_name, fleet_name
from iort_contract.messages.live import LEASE, lease_topic
from iort_contract.messages.video import answer_topic, look_topic, picture_topic
from iort_contract.topics import (
    ANSWER,
    ASK,
    BROKER,
    CMD,
    FLEET,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    VIEW,
    build_topic,
    live_topic,
    record_topic,
    rule_name,
)

# Robot A makes the attempts; B is its neighbour.
A, B = "isolated-a", "isolated-b"
ROBOT, CLAIM = "robot A", "claim"
# The names of two viewers.
ME, OTHER = "0badcafe", "5ca1ab1e"
# IAM roles: of the operator's people, and of whoever opens the page on the web.
VIEWER, DRIVER, EVERYBODY = "viewer", "driver", "everybody"
CONNECT, PUBLISH, SUBSCRIBE, RECEIVE = "Connect", "Publish", "Subscribe", "Receive"


class Row(NamedTuple):
    """``what`` is a client id, a topic or a topic filter."""

    who: str
    does: str
    what: str
    allowed: bool


def _rows(who: str, does: str, *, may: tuple[str, ...], may_not: tuple[str, ...]) -> list[Row]:
    return [
        Row(who, does, what, allowed) for group, allowed in ((may, True), (may_not, False)) for what in group
    ]


def _shadow(robot: str, name: str = f"/name/{SHADOW}") -> str:
    return f"$aws/things/{robot}/shadow{name}"


_PROVISION = f"$aws/provisioning-templates/{fleet_name()}/provision/json"
_CSR = "$aws/certificates/create-from-csr/json"

ROWS = [
    *_rows(
        ROBOT,
        CONNECT,
        may=(A,),
        may_not=(B, f"{A}-2", A.upper(), A[:-1], "iort-claim-1", "anything"),
    ),
    *_rows(
        ROBOT,
        PUBLISH,
        may=(
            record_topic(A, "vesc"),
            live_topic(A, "vesc"),
            build_topic(LIVE, A, "vesc"),
            build_topic(FLEET, A, "pose"),
            build_topic(PING, A, BROKER),
            build_topic(PING, A, RULE),
            build_topic(PING, A, LAMBDA),
            build_topic(ASK, A, CALIBRATION.name),
            build_topic(ASK, A, "nobody"),
            # It wakes only itself, and shows itself to itself.
            build_topic(VIEW, A, LEASE),
            look_topic(A, "iort"),
            answer_topic(A, ME, "iort"),
            picture_topic(A, "iort"),
            f"{_shadow(A)}/get",
            f"{_shadow(A)}/update",
        ),
        may_not=(
            # Another robot's topics.
            record_topic(B, "vesc"),
            live_topic(B, "vesc"),
            build_topic(LIVE, B, "vesc"),
            *(f"{LIVE}/iort/{other}/vesc" for other in (f"{A}-2", A[:-1], A.upper())),
            build_topic(FLEET, B, "pose"),
            build_topic(PING, B, RULE),
            build_topic(CMD, B, "drive"),
            build_topic(PONG, B, RULE),
            build_topic(ASK, B, CALIBRATION.name),
            build_topic(ANSWER, B, CALIBRATION.name),
            build_topic(VIEW, B, LEASE),
            look_topic(B, "iort"),
            answer_topic(B, ME, "iort"),
            picture_topic(B, "iort"),
            answer_topic(A, ME, "lab2"),
            f"{_shadow(B)}/update",
            f"{_shadow(B)}/get",
            f"{_shadow(B)}/delete",
            f"$aws/things/{B}/jobs/start-next",
            f"$aws/things/{B}/jobs/1/update",
            # Messages of the operator and of the cloud.
            build_topic(CMD, A, "drive"),
            build_topic(PONG, A, RULE),
            build_topic(ANSWER, A, CALIBRATION.name),
            f"$aws/events/presence/connected/{A}",
            f"$aws/events/presence/disconnected/{B}",
            # Topics without Basic Ingest, Basic Ingest to other rules, and Basic Ingest with another
            # deployment's or robot's topic.
            build_topic(RECORD, A, "vesc"),
            *(f"$aws/rules/{rule_name(rule)}/{RECORD}/iort/{A}/vesc" for rule in RULES if rule != "record"),
            *(f"$aws/rules/{rule_name(rule)}/{LIVE}/iort/{A}/vesc" for rule in RULES if rule != "live"),
            f"$aws/rules/{rule_name('ask')}/{ASK}/iort/{B}/{CALIBRATION.name}",
            f"$aws/rules/{rule_name('live')}/{LIVE}/iort",
            live_topic(A, "vesc", "lab2"),
            f"$aws/rules/{rule_name('live', 'lab2')}/{LIVE}/iort/{A}/vesc",
            f"$aws/rules/{rule_name('live')}/{LIVE}/lab2/{A}/vesc",
            f"$aws/rules/{rule_name('presence')}/$aws/events/presence/connected/{B}",
            # Reserved topics that no agent needs.
            f"{_shadow(A, '')}/update",
            f"{_shadow(A, '/name/other')}/update",
            f"$aws/things/{A}/jobs/start-next",
            f"$aws/things/{A}/defender/metrics/json",
            "$aws/certificates/create/json",
            _CSR,
            _PROVISION,
            # Other deployments, other topic levels.
            build_topic(LIVE, A, "vesc", "lab2"),
            f"{LIVE}/iort",
            f"{LIVE}/iort/{A}",
            f"{LIVE}/iort/x/{A}/vesc",
            "anything/else",
        ),
    ),
    *_rows(
        ROBOT,
        SUBSCRIBE,
        may=(
            build_topic(CMD, A, "drive"),
            f"{CMD}/iort/{A}/+",
            f"{CMD}/iort/{A}/#",
            f"{PONG}/iort/{A}/+",
            f"{ANSWER}/iort/{A}/+",
            build_topic(VIEW, A, LEASE),
            look_topic(A, "iort"),
            build_topic(PING, A, BROKER),
            f"{PING}/iort/{A}/+",
            f"{FLEET}/iort/+/#",
            f"{FLEET}/iort/{B}/pose",
            f"{_shadow(A)}/update/accepted",
        ),
        may_not=(
            build_topic(CMD, B, "drive"),
            f"{CMD}/iort/{B}/#",
            f"{CMD}/iort/+/drive",
            f"{CMD}/iort/#",
            f"{CMD}/#",
            f"{PONG}/iort/{B}/{RULE}",
            f"{PONG}/iort/+/{RULE}",
            f"{PING}/iort/+/{BROKER}",
            f"{PING}/iort/{B}/{BROKER}",
            f"{PING}/lab2/{A}/{BROKER}",
            f"{ANSWER}/iort/{B}/{CALIBRATION.name}",
            f"{ANSWER}/iort/+/{CALIBRATION.name}",
            build_topic(VIEW, B, LEASE),
            f"{VIEW}/iort/+/{LEASE}",
            look_topic(B, "iort"),
            look_topic(A, "lab2"),
            answer_topic(B, ME, "iort"),
            picture_topic(B, "iort"),
            f"{VIEW}/iort/+/video",
            f"{VIEW}/iort/+/picture",
            f"{VIEW}/iort/#",
            f"{ASK}/iort/{A}/+",
            f"{ASK}/iort/{B}/{CALIBRATION.name}",
            f"{LIVE}/iort/{A}/vesc",
            live_topic(A, "vesc"),
            live_topic(B, "vesc"),
            f"{LIVE}/iort/{B}/vesc",
            f"{RECORD}/#",
            f"{RECORD}/iort/{B}/vesc",
            f"{FLEET}/#",
            f"{FLEET}/lab2/+/#",
            "#",
            "+/#",
            "+/iort/#",
            "+/+/+/+",
            f"+/iort/{A}/+",
            f"+/aw/iort/{B}/x",
            f"$share/group/{CMD}/iort/{B}/#",
            "$aws/#",
            "$aws/events/#",
            "$aws/events/presence/connected/+",
            "$aws/things/#",
            "$aws/things/+/shadow/#",
            f"{_shadow(B)}/update/accepted",
            f"{_shadow('+')}/update/accepted",
            f"{_shadow(A, '')}/update/accepted",
            f"{_shadow(A, '/name/+')}/update/accepted",
            f"$aws/things/{A}/jobs/notify-next",
            f"$aws/things/{B}/jobs/notify-next",
            f"{_CSR}/accepted",
        ),
    ),
    *_rows(
        ROBOT,
        RECEIVE,
        may=(
            build_topic(CMD, A, "drive"),
            build_topic(PONG, A, RULE),
            build_topic(ANSWER, A, CALIBRATION.name),
            build_topic(VIEW, A, LEASE),
            look_topic(A, "iort"),
            build_topic(FLEET, B, "pose"),
            f"{_shadow(A)}/update/accepted",
        ),
        may_not=(
            build_topic(CMD, B, "drive"),
            build_topic(PONG, B, RULE),
            build_topic(ANSWER, B, CALIBRATION.name),
            build_topic(VIEW, B, LEASE),
            look_topic(B, "iort"),
            answer_topic(B, ME, "iort"),
            picture_topic(B, "iort"),
            build_topic(LIVE, B, "vesc"),
            build_topic(PING, B, BROKER),
            f"{_shadow(B)}/update/accepted",
            f"$aws/things/{A}/jobs/notify-next",
            f"$aws/events/presence/connected/{B}",
        ),
    ),
    *_rows(
        CLAIM,
        CONNECT,
        may=(f"{claim_name()}-1",),
        may_not=(A, B, claim_name(), "lab2-claim-1", "anything"),
    ),
    *_rows(
        CLAIM,
        PUBLISH,
        may=(_CSR, _PROVISION),
        may_not=(
            # AWS would create the private key and send it over the network.
            "$aws/certificates/create/json",
            "$aws/provisioning-templates/other/provision/json",
            record_topic(A, "vesc"),
            live_topic(A, "vesc"),
            build_topic(RECORD, A, "vesc"),
            build_topic(LIVE, A, "vesc"),
            build_topic(CMD, A, "drive"),
            build_topic(FLEET, A, "pose"),
            build_topic(VIEW, A, LEASE),
            look_topic(A, "iort"),
            answer_topic(A, ME, "iort"),
            picture_topic(A, "iort"),
            f"{_shadow(A)}/update",
            f"$aws/things/{A}/jobs/start-next",
            "anything/else",
        ),
    ),
    *_rows(
        CLAIM,
        SUBSCRIBE,
        may=(f"{_CSR}/accepted", f"{_CSR}/rejected", f"{_PROVISION}/accepted", f"{_PROVISION}/rejected"),
        may_not=(
            "#",
            "$aws/#",
            "$aws/certificates/#",
            "$aws/certificates/create/json/accepted",
            "$aws/certificates/+/json/accepted",
            "$aws/provisioning-templates/+/provision/json/accepted",
            f"{FLEET}/iort/+/#",
            build_topic(CMD, A, "drive"),
            look_topic(A, "iort"),
            answer_topic(A, ME, "iort"),
            picture_topic(A, "iort"),
            f"{_shadow(A)}/update/accepted",
        ),
    ),
]

# What wakes a robot's live lane and its camera.
_LOOKS = tuple(topic(robot, "iort") for topic in (lease_topic, look_topic) for robot in (A, B))
_COMMANDS = (build_topic(CMD, A, "drive"), build_topic(CMD, B, "drive"))
# What neither people nor everybody may send.
_NOT_SENT = (
    record_topic(A, "vesc"),
    live_topic(A, "vesc"),
    build_topic(LIVE, A, "vesc"),
    build_topic(RECORD, A, "vesc"),
    build_topic(FLEET, A, "pose"),
    build_topic(PING, A, RULE),
    build_topic(PONG, A, RULE),
    build_topic(ASK, A, CALIBRATION.name),
    build_topic(ANSWER, A, CALIBRATION.name),
    build_topic(CMD, A, "drive", "lab2"),
    lease_topic(A, "lab2"),
    look_topic(A, "lab2"),
    # A false picture, a false answer: only the robot sends them.
    picture_topic(A, "iort"),
    answer_topic(A, OTHER, "iort"),
    build_topic(VIEW, A, "anything"),
    f"{_shadow(A)}/update",
    f"{_shadow(A)}/get",
    f"$aws/events/presence/connected/{A}",
    _PROVISION,
    "anything/else",
)
_HEARD = (f"{LIVE}/iort/+/+", f"{LIVE}/iort/{A}/+", f"{LIVE}/iort/{B}/vesc", f"{LIVE}/iort/#")
# Live messages that are not for everybody: the agent's log, and who drives.
_OPERATORS = (build_topic(LIVE, A, LOG_STREAM), build_topic(LIVE, B, DRIVE_STREAM))
# Video: a robot's answers to a viewer, and its pictures over the broker.
_SEEN = (answer_topic(A, ME, "iort"), answer_topic(B, ME, "iort"), picture_topic(A, "iort"))
_NOT_HEARD = (
    # Other viewers' offers, and their answers without knowing their names.
    *(
        f"{VIEW}/{levels}"
        for levels in ("iort/+/video", f"iort/{A}/video", "iort/+/+", "iort/#", "+/+/+", "#")
    ),
    *(f"{VIEW}/lab2/{A}/{name}" for name in ("picture", f"to-{ME}")),
    *("#", "+/#", "+/iort/#", f"{LIVE}/#", f"{LIVE}/+/+/+", f"{LIVE}/lab2/+/+", "$aws/#"),
    *(f"{lane}/iort/{A}/+" for lane in (CMD, VIEW, RECORD, FLEET, PING, PONG, ASK, ANSWER)),
    f"{_shadow(A)}/update/accepted",
    "$aws/events/presence/connected/+",
    f"$share/group/{CMD}/iort/{A}/#",
)
for _who, _client, _sends in (
    (VIEWER, VIEWER, _LOOKS),
    (DRIVER, DRIVER, (*_LOOKS, *_COMMANDS)),
    (EVERYBODY, VIEWER, ()),
):
    _others = (A, "iort", f"iort-{_client}", "iort-claim-1", f"lab2-{_client}-1", "anything")
    _other = DRIVER if _client == VIEWER else VIEWER
    _rest = tuple(topic for topic in (*_LOOKS, *_COMMANDS) if topic not in _sends)
    ROWS += [
        *_rows(_who, CONNECT, may=(f"iort-{_client}-1",), may_not=(*_others, f"iort-{_other}-1")),
        *_rows(_who, PUBLISH, may=_sends, may_not=(*_rest, *_NOT_SENT)),
        *_rows(_who, SUBSCRIBE, may=_HEARD, may_not=_NOT_HEARD),
        *_rows(
            _who,
            RECEIVE,
            may=(build_topic(LIVE, A, "vesc"), build_topic(LIVE, B, "pose")),
            may_not=(
                build_topic(CMD, A, "drive"),
                lease_topic(A, "iort"),
                look_topic(A, "iort"),
                build_topic(FLEET, A, "pose"),
            ),
        ),
        *(
            Row(_who, does, what, _who != EVERYBODY)
            for does in (SUBSCRIBE, RECEIVE)
            for what in (*_OPERATORS, *_SEEN)
        ),
        Row(_who, SUBSCRIBE, f"{VIEW}/iort/+/picture", _who != EVERYBODY),
    ]

# Requests that every role of the stacks makes to every resource of a kind. Only the role that declares a
# request may make it.
TABLE_ACTIONS = (
    "GetItem",
    "PutItem",
    "UpdateItem",
    "DeleteItem",
    "Query",
    "Scan",
    "BatchWriteItem",
    "DeleteTable",
)
QUEUE_ACTIONS = ("SendMessage", "ReceiveMessage", "DeleteMessage", "PurgeQueue", "GetQueueAttributes")
BUCKET_ACTIONS = ("ListBucket", "DeleteBucket")
OBJECT_ACTIONS = ("GetObject", "PutObject", "DeleteObject")
OBJECTS = ("robots/isolated-b/x", "robots/isolated-b/x/ask/x", "results/x", "results/ask/x", "x")
PARAMETER_ACTIONS = ("GetParameter", "PutParameter", "DeleteParameter")
FUNCTION_ACTIONS = ("InvokeFunction", "UpdateFunctionConfiguration")
LOG_ACTIONS = ("CreateLogStream", "PutLogEvents", "GetLogEvents")
# A thing's shadows: the settings, another name, and the one without a name.
SHADOWS = {f"{A}/{SHADOW}": SHADOW, f"{A}/other": "other", A: None}
TOPICS = (
    build_topic(CMD, B, "drive"),
    build_topic(LIVE, B, "vesc"),
    build_topic(RECORD, B, "vesc"),
    build_topic(FLEET, B, "pose"),
    build_topic(PONG, B, RULE),
    build_topic(PONG, B, LAMBDA),
    build_topic(PONG, B, "file"),
    build_topic(PONG, B, LAMBDA, "lab2"),
    build_topic(ANSWER, B, CALIBRATION.name),
    build_topic(ANSWER, B, "nobody"),
    build_topic(ANSWER, B, CALIBRATION.name, "lab2"),
    look_topic(B, "iort"),
    answer_topic(B, ME, "iort"),
    picture_topic(B, "iort"),
)
