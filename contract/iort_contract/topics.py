"""Names, and the topics built from them."""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from typing import NamedTuple

from iort_contract.checks import checked, shown
from iort_contract.limits import DEFAULT_NAMESPACE, ContractError

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
# Rule names allow no dash and must differ between stages, so the namespace is stricter.
_RULE = re.compile(r"[a-z]{1,32}")
_NAMESPACE = re.compile(r"[a-z][a-z0-9]{0,15}")

RECORD, LIVE, FLEET, CMD, PING, PONG = "dt", "live", "fleet", "cmd", "ping", "pong"
# A robot's questions to functions of the cloud, and their answers.
ASK, ANSWER = "ask", "answer"
# In the names of claims, behind the namespace.
CLAIM = "claim"
# Who looks at a robot's live lane.
VIEW = "view"
LANES = (RECORD, LIVE, FLEET, CMD, PING, PONG, ASK, ANSWER, VIEW)
BROKER, RULE, LAMBDA = "broker", "rule", "lambda"
# Another question on the lanes ping and pong: upload addresses of a file.
FILE = "file"
PING_PATHS = (BROKER, RULE, LAMBDA)
# The named shadow of a robot's thing with the agent's settings.
SHADOW = "agent"
# In the shadow: the results of commands that asked for an answer.
COMMANDS, ACCEPTED = "commands", "accepted"


class Topic(NamedTuple):
    """A parsed topic, ``<lane>/<namespace>/<robot>/<name>``.

    ``name`` is the stream (record, live), the path (ping, pong), the message's own name (fleet, cmd, view)
    or the function (ask, answer).
    """

    lane: str
    namespace: str
    robot: str
    name: str

    def __str__(self) -> str:
        return "/".join(self)


def check_robot(name: str) -> str:
    """Return ``name`` if it is a valid robot name: thing name, client id and topic level alike."""
    return checked(NAME, name, "robot name", "1 to 64 of A-Z a-z 0-9 _ -")


def check_stream(name: str) -> str:
    """Return ``name`` if it is a valid stream name, or last level of any topic."""
    return checked(NAME, name, "stream name", "1 to 64 of A-Z a-z 0-9 _ -")


def check_namespace(name: str) -> str:
    """Return ``name`` if it is a valid namespace of a deployment."""
    return checked(_NAMESPACE, name, "namespace", "a lower-case letter, then up to 15 of a-z 0-9")


def build_topic(lane: str, robot: str, name: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The topic of a robot's message; raises `ContractError` for an invalid level."""
    if lane not in LANES:
        raise ContractError(f"lane must be one of {', '.join(LANES)}, got {shown(lane)}")
    return str(Topic(lane, check_namespace(namespace), check_robot(robot), check_stream(name)))


def parse_topic(topic: str) -> Topic:
    """Parse a topic; raises `ContractError` for one that `build_topic` cannot have built."""
    if not isinstance(topic, str) or topic.count("/") != len(Topic._fields) - 1:
        raise ContractError(f"topic must be <lane>/<namespace>/<robot>/<name>, got {shown(topic)}")
    return _parsed(topic)


# Each message names its topic, and most of them the same.
@lru_cache(maxsize=4096)
def _parsed(topic: str) -> Topic:
    parsed = Topic(*topic.split("/"))
    build_topic(parsed.lane, parsed.robot, parsed.name, parsed.namespace)
    return parsed


def record_topic(robot: str, stream: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The topic for a robot's batches: straight to the rule, by Basic Ingest, which costs no messaging. The
    rule's ``topic()`` sees ``dt/<namespace>/<robot>/<stream>``."""
    return _straight_to("record", build_topic(RECORD, robot, stream, namespace), namespace)


def live_topic(robot: str, stream: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The topic for live messages that only the live rule needs: by Basic Ingest, like `record_topic`. All
    other live messages go to ``live/<namespace>/<robot>/<stream>``."""
    return _straight_to("live", build_topic(LIVE, robot, stream, namespace), namespace)


def _straight_to(rule: str, topic: str, namespace: str) -> str:
    return f"$aws/rules/{rule_name(rule, namespace)}/{topic}"


def as_subscribed(topic: str, rule: str) -> str:
    """The topic without Basic Ingest's prefix of that rule (physical name).

    ``topic()`` leaves it out; AWS does not document whether an error action's document does.
    """
    prefix = f"$aws/rules/{rule}/"
    return topic[len(prefix) :] if topic.startswith(prefix) else topic


def rule_name(rule: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The physical name of a topic rule; robots need two of them for Basic Ingest."""
    return f"{check_namespace(namespace)}_{checked(_RULE, rule, 'rule', 'up to 32 lower-case letters')}"


# Streams that are named after ROS topics.

MAX_STREAM = 64


def stream_of(topic: str) -> str:
    """The stream of a topic that names none. No two topics have the same: `-` is in no topic's name."""
    name = topic.strip("/").replace("/", "-")
    if len(name) > MAX_STREAM:
        digest = hashlib.sha256(topic.encode()).hexdigest()[:8]
        name = f"{name[: MAX_STREAM - 9]}-{digest}"
    return name


def matches(pattern: str, topic: str) -> bool:
    """Whether a topic fits a pattern. Hidden topics, whose names have a part that begins with `_`, fit
    none."""
    return "/_" not in topic and _compiled(pattern).fullmatch(topic) is not None


@lru_cache(maxsize=256)
def _compiled(pattern: str) -> re.Pattern[str]:
    return re.compile(".*".join(map(re.escape, pattern.split("*"))))
