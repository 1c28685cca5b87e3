"""The topic rules. The stacks make each rule, its role, grants and dashboard line from its entry here.

To add a rule, add an entry, and ``functions/<name>.py`` if it calls a new function.
"""

from __future__ import annotations

from dataclasses import dataclass

from iort_contract.catalog.vesc import FAULT_FIELD, VOLTAGE_FIELD
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_contract.tables import (
    AGENT_VERSION,
    ENVELOPE,
    EXPIRES_S,
    MESSAGE_BASE64,
    PING_FIELDS,
    RECEIVED_MS,
    ROBOT,
    TOPIC,
)
from iort_contract.topics import (
    ASK,
    CLAIM,
    FILE,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    check_namespace,
    rule_name,
)

# A battery of three lithium cells below this is nearly empty; a deployment can set another value.
LOW_VOLTAGE_V = 10.5
DAY_S = 86_400


@dataclass(frozen=True)
class Store:
    """Put the selected keys into a table of the stack storage, by its attribute there."""

    table: str


@dataclass(frozen=True)
class Call:
    """Call the function of ``functions/<function>.py``."""

    function: str


@dataclass(frozen=True)
class Republish:
    """Publish to ``<lane>/<namespace>/<robot>/<name>``; the rules engine fills in the sender."""

    lane: str
    name: str

    def topic(self, namespace: str, robot: str = "${topic(3)}") -> str:
        """The topic; ``robot`` may be a pattern."""
        return f"{self.lane}/{check_namespace(namespace)}/{robot}/{self.name}"


@dataclass(frozen=True)
class Rule:
    """A topic rule. ``sql`` may name the parameters of `statement` in braces.

    Messages that the action rejects go to ``error_queue``, a queue of the stack quarantine.
    """

    name: str
    meaning: str
    sql: str
    action: Store | Call | Republish
    error_queue: str = "rejected"

    def statement(
        self,
        namespace: str = DEFAULT_NAMESPACE,
        *,
        retention_s: int = 90 * DAY_S,
        low_voltage_v: float = LOW_VOLTAGE_V,
    ) -> str:
        """The SQL for a deployment."""
        return self.sql.format(
            namespace=check_namespace(namespace),
            retention_s=retention_s,
            low_voltage_v=low_voltage_v,
        )

    def physical_name(self, namespace: str = DEFAULT_NAMESPACE) -> str:
        """The name in AWS IoT."""
        return rule_name(self.name, namespace)


# A rule that adds keys of the cloud never selects * beside them: AWS does not document which of two keys of
# one name stays. It selects the message's keys by name, or the message as one opaque value.
_RECEIVED = f"timestamp() AS {RECEIVED_MS}"
_FROM = f"topic() AS {TOPIC}, {_RECEIVED}"
# Raw bytes, JSON or not.
_BYTES = f"encode(*, 'base64') AS {MESSAGE_BASE64}, {_FROM}"
_VERSION = f"state.reported.{AGENT_VERSION}"
# "Lifecycle events": principalIdentifier is a certificate's id, of 64 characters ("Certificate" in the API
# reference), or the IAM credentials that viewers, drivers and strangers have. A claim has a certificate, and
# a client id of its own. What the rule leaves out calls no function.
_OF_A_ROBOT = (
    "regexp_matches(principalIdentifier, '^[a-fA-F0-9x]{{64}}$')"
    f" AND NOT regexp_matches(clientId, '^{{namespace}}-{CLAIM}-')"
)

RULES = {
    rule.name: rule
    for rule in (
        Rule(
            "record",
            "stores batches",
            f"SELECT {', '.join(ENVELOPE)}, {_FROM},"
            f" floor(timestamp() / 1000) + {{retention_s}} AS {EXPIRES_S} FROM '{RECORD}/{{namespace}}/+/+'",
            Store("telemetry"),
        ),
        Rule(
            "live",
            "sends live samples to the dashboard",
            f"SELECT {_BYTES} FROM '{LIVE}/{{namespace}}/+/+'",
            Call("live"),
        ),
        Rule(
            "pong",
            "answers a ping by itself",
            f"SELECT {', '.join(PING_FIELDS)}, {_RECEIVED} FROM '{PING}/{{namespace}}/+/{RULE}'",
            Republish(PONG, RULE),
        ),
        Rule(
            "echo",
            "answers a ping by a function",
            f"SELECT {_BYTES} FROM '{PING}/{{namespace}}/+/{LAMBDA}'",
            Call("echo"),
        ),
        Rule(
            "upload",
            "answers requests for upload addresses",
            f"SELECT {_BYTES} FROM '{PING}/{{namespace}}/+/{FILE}'",
            Call("upload"),
        ),
        Rule(
            "ask",
            "answers the questions of robots",
            f"SELECT {_BYTES} FROM '{ASK}/{{namespace}}/+/+'",
            Call("answer"),
        ),
        Rule(
            "presence",
            "notes in the registry which robots connect and disconnect",
            f"SELECT * FROM '$aws/events/presence/+/+' WHERE eventType <> 'connect_failed' AND {_OF_A_ROBOT}",
            Call("presence"),
        ),
        Rule(
            "version",
            "notes in the registry which agent a robot runs",
            f"SELECT {_VERSION} AS {AGENT_VERSION}, topic(3) AS {ROBOT}"
            f" FROM '$aws/things/+/shadow/name/{SHADOW}/update/accepted' WHERE {_VERSION} <> ''",
            Call("presence"),
        ),
        # Two rules instead of OR, which AWS IoT calls Undefined if either side compares with null.
        Rule(
            "fault",
            "mails a controller's fault",
            f"SELECT sample.{FAULT_FIELD} AS {FAULT_FIELD}, {_FROM} FROM '{LIVE}/{{namespace}}/+/+'"
            f" WHERE sample.{FAULT_FIELD} > 0",
            Call("alert"),
        ),
        # A controller that does not measure its voltage says 0.
        Rule(
            "battery",
            "mails a low battery",
            f"SELECT sample.{VOLTAGE_FIELD} AS {VOLTAGE_FIELD}, {_FROM} FROM '{LIVE}/{{namespace}}/+/+'"
            f" WHERE sample.{VOLTAGE_FIELD} > 0 AND sample.{VOLTAGE_FIELD} < {{low_voltage_v:g}}",
            Call("alert"),
        ),
    )
}
