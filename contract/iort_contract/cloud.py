"""The names of the cloud's parts: rules, metrics, the files' bucket, PubNub's channels."""

from __future__ import annotations

from iort_contract.catalog.vesc import FAULT_FIELD, VOLTAGE_FIELD
from iort_contract.checks import shown
from iort_contract.limits import DEFAULT_NAMESPACE, ContractError
from iort_contract.messages.event import MESSAGE_BASE64
from iort_contract.messages.live import PING_FIELDS
from iort_contract.tables import AGENT_VERSION, ENVELOPE, EXPIRES_S, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import (
    FILE,
    LAMBDA,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    RULES,
    SHADOW,
    check_namespace,
    check_robot,
)

# The broker publishes connects and disconnects here.
_PRESENCE = "$aws/events/presence"
# A battery of three lithium cells below this is nearly empty; a deployment can set another value.
LOW_VOLTAGE_V = 10.5
# Query results too large for an answer, in the files' bucket for a day.
RESULTS_PREFIX = "results/"

METRIC_NAMESPACE = "iort"
# The dimensions of every metric: the deployment's namespace and the function.
METRIC_DEPLOYMENT, METRIC_FUNCTION = "Deployment", "Function"
# The third dimension, with `robot_metrics`: AWS bills each robot's metrics.
METRIC_ROBOT = "Robot"
METRICS = {
    "live": (
        "LivePublished",
        "LiveStale",
        "LiveRefused",
        "LiveCutOff",
        "PubNubFailed",
        "InCarMs",
        "UplinkMs",
        "ToLambdaMs",
        "CarToLambdaMs",
    ),
    "summarize": (
        "BatchesSummarized",
        "SamplesSummarized",
        "BatchesRefused",
        "BatchesMissing",
        "BatchesPutOff",
    ),
    "health": (
        "AgentReports",
        "SampleGaps",
        "FaultSamples",
        "BatteryVolts",
        "TemperatureDegC",
        "BacklogBatches",
        "RoundTripBrokerMs",
        "RoundTripRuleMs",
        "RoundTripLambdaMs",
    ),
    "alert": ("AlertsSent", "AlertsHeld"),
    "echo": ("PongsSent",),
    "upload": ("FilesAsked", "FilesStored", "FilesRefused", "StoredBytes"),
    "admit": ("RobotsAdmitted", "RobotsRefused"),
    "presence": ("RobotsConnected", "RobotsDisconnected", "PresenceIgnored"),
    "quarantine": ("Quarantined",),
}


def rule_sql(
    rule: str,
    namespace: str = DEFAULT_NAMESPACE,
    retention_s: int = 90 * 86_400,
    low_voltage_v: float = LOW_VOLTAGE_V,
) -> str:
    """The SELECT of a topic rule.

    A rule that adds keys of the cloud (topic, receipt, expiry) never selects ``*`` beside them: AWS does not
    document which of two keys of one name stays. It selects the message's keys by name, or the message as one
    opaque value.
    """
    name = check_namespace(namespace)
    received = f"timestamp() AS {RECEIVED_MS}"
    # Raw bytes, JSON or not.
    message = f"encode(*, 'base64') AS {MESSAGE_BASE64}, topic() AS {TOPIC}, {received}"
    if rule == "record":
        expires = f"floor(timestamp() / 1000) + {retention_s} AS {EXPIRES_S}"
        said = f"topic() AS {TOPIC}, {received}, {expires}"
        return f"SELECT {', '.join(ENVELOPE)}, {said} FROM '{RECORD}/{name}/+/+'"
    if rule == "live":
        return f"SELECT {message} FROM '{LIVE}/{name}/+/+'"
    if rule == "pong":
        return f"SELECT {', '.join(PING_FIELDS)}, {received} FROM '{PING}/{name}/+/{RULE}'"
    if rule == "echo":
        return f"SELECT {message} FROM '{PING}/{name}/+/{LAMBDA}'"
    if rule == "upload":
        return f"SELECT {message} FROM '{PING}/{name}/+/{FILE}'"
    if rule == "presence":
        return f"SELECT * FROM '{_PRESENCE}/+/+' WHERE eventType <> 'connect_failed'"
    if rule == "version":
        reported = f"state.reported.{AGENT_VERSION}"
        return (
            f"SELECT {reported} AS {AGENT_VERSION}, topic(3) AS {ROBOT} "
            f"FROM '$aws/things/+/shadow/name/{SHADOW}/update/accepted' WHERE {reported} <> ''"
        )
    # Two rules instead of OR, which AWS IoT calls Undefined if either side compares with null.
    if rule == "fault":
        return _alert_sql(FAULT_FIELD, name, f"sample.{FAULT_FIELD} > 0")
    if rule == "battery":
        # A controller that does not measure its voltage says 0.
        low = f"sample.{VOLTAGE_FIELD} > 0 AND sample.{VOLTAGE_FIELD} < {low_voltage_v:g}"
        return _alert_sql(VOLTAGE_FIELD, name, low)
    raise ContractError(f"rule must be one of {', '.join(RULES)}, got {shown(rule)}")


def _alert_sql(field: str, namespace: str, condition: str) -> str:
    return (
        f"SELECT sample.{field} AS {field}, topic() AS {TOPIC}, timestamp() AS {RECEIVED_MS} "
        f"FROM '{LIVE}/{namespace}/+/+' WHERE {condition}"
    )


def pong_template(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The republish action's topic; the rules engine expands ``${topic(3)}`` to the robot."""
    return f"{PONG}/{check_namespace(namespace)}/${{topic(3)}}/{RULE}"


def pubnub_parameter(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The Parameter Store name (SecureString) of PubNub's keys: a JSON object with ``publish_key``,
    ``subscribe_key`` and, for a server other than PubNub's own, ``origin`` and ``tls``."""
    return f"/{check_namespace(namespace)}/pubnub"


def fleet_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name shared by the robots' thing type, thing group, IoT policy and provisioning template."""
    return f"{check_namespace(namespace)}-robot"


def claim_name(namespace: str = DEFAULT_NAMESPACE) -> str:
    """The name of the claims' IoT policy, and the prefix of a claim's client id."""
    return f"{check_namespace(namespace)}-claim"


def channel(robot: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The PubNub channel of a robot; ``<namespace>.*`` subscribes to the whole fleet."""
    return f"{check_namespace(namespace)}.{check_robot(robot)}"
