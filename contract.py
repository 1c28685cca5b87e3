"""What both ends of every wire agree on: names, units, envelopes and limits.

The robot, the Lambda functions, the stacks and the operator's station all import this one file,
so it needs nothing but Python 3.8's standard library. Units are in the names (``_us`` microseconds,
``_ms`` milliseconds, ``_s`` seconds since the Unix epoch) or in `VESC_FIELDS`.

Everything here that refuses its input raises `ContractError`, and nothing else.
"""

from __future__ import annotations

import base64
import binascii
import calendar
import json
import math
import re
import time
import zlib
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any, Mapping, NamedTuple, Sequence, Union

SCHEMA_VERSION = 1
DEFAULT_NAMESPACE = "iort"

# AWS IoT Core closes a connection that publishes more than 128 KB ("Message size", service quotas),
# and an MQTT 5 client counts topic and header in: a kilobyte is left to them.
MAX_MESSAGE_BYTES = 127 * 1024
# PubNub refuses a message above 32 KiB, measured after URL encoding.
MAX_PUBNUB_BYTES = 32 * 1024
# A live message older than this when Lambda 1 sees it is dropped: the dashboard shows now.
LIVE_MAX_AGE_MS = 2_000
# A car says by how much its clock and the cloud's differ only where it knows that well enough to judge
# by: wrong by a quarter of the age above at most.
CLOCK_MAX_UNCERTAINTY_MS = 500
LIVE_MAX_RATE_HZ = 10.0

# Bounds that keep a hostile or broken message from costing more than a good one.
MAX_SAMPLES = 50_000
# A clock that is off by more than this has no date at all: of a dead battery, or of an overflow. Lambda 2
# then refuses the batch; a car that believes in 1970 is let through, replayed drives are as old.
MAX_AHEAD_US = 366 * 86_400 * 1_000_000
# A batch closes after a second, so a range read starts one second early and misses nothing.
MAX_BATCH_SPAN_US = 1_000_000
MAX_FIELDS = 512
MAX_COLUMNS_BYTES = 8 * 1024 * 1024

Value = Union[None, bool, int, float, str]


class ContractError(ValueError):
    """A name, topic, message or item that the contract does not allow; the text says which."""


# --- names and topics ---------------------------------------------------------------------------

_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
# Rule names allow no dash and start the names of two stages apart, so the namespace is stricter.
_NAMESPACE = re.compile(r"[a-z][a-z0-9]{0,15}")
# A ROS field name, or a path of them; a number in a path is an array's index.
_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*(\.[A-Za-z0-9_]+)*")

RECORD, LIVE, FLEET, CMD, PING, PONG = "dt", "live", "fleet", "cmd", "ping", "pong"
LANES = (RECORD, LIVE, FLEET, CMD, PING, PONG)
BROKER, RULE, LAMBDA = "broker", "rule", "lambda"
# What else is asked and answered on the lanes ping and pong: where a file may be uploaded to.
FILE = "file"
PING_PATHS = (BROKER, RULE, LAMBDA)
# Round trips are a stream like any other: one sample a pong, the other paths' fields None.
RTT_STREAM = "rtt"
RTT_FIELDS = {path: f"{path}_ms" for path in PING_PATHS}
# What the agent says of itself; the fields are AGENT_FIELDS.
AGENT_STREAM = "agent"
# What the messages were that a stream's samples are made of: `MessageType`.
TYPES_STREAM = "types"
# The streams that every robot may have and no source's configuration names.
OWN_STREAMS = frozenset({RTT_STREAM, AGENT_STREAM, TYPES_STREAM})
# The named shadow of a robot's thing that carries the agent's settings.
SHADOW = "agent"
# Where the shadow says what became of the commands that asked for an answer.
COMMANDS, ACCEPTED = "commands", "accepted"


class Topic(NamedTuple):
    """A parsed topic, ``<lane>/<namespace>/<robot>/<name>``.

    ``name`` is the stream (record, live), the path (ping, pong) or the message's own (fleet, cmd).
    """

    lane: str
    namespace: str
    robot: str
    name: str

    def __str__(self) -> str:
        return "/".join(self)


def check_robot(name: str) -> str:
    """Return ``name`` if it may name a robot: thing name, client id and topic level alike."""
    return _checked(_NAME, name, "robot name", "1 to 64 of A-Z a-z 0-9 _ -")


def check_stream(name: str) -> str:
    """Return ``name`` if it may name a stream or be the last level of any topic."""
    return _checked(_NAME, name, "stream name", "1 to 64 of A-Z a-z 0-9 _ -")


def check_field(name: str) -> str:
    """Return ``name`` if it may name a field."""
    return _checked(_FIELD, name, "field name", "a ROS field name or a dotted path of them")


def check_namespace(name: str) -> str:
    """Return ``name`` if it may be a deployment's namespace."""
    return _checked(_NAMESPACE, name, "namespace", "a lower-case letter, then up to 15 of a-z 0-9")


def _checked(pattern: re.Pattern[str], name: str, what: str, allowed: str) -> str:
    if not isinstance(name, str) or not pattern.fullmatch(name):
        raise ContractError(f"{what} {_show(name)}: allowed is {allowed}")
    return name


def build_topic(lane: str, robot: str, name: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The topic of a robot's message; raises `ContractError` where a level is not allowed."""
    if lane not in LANES:
        raise ContractError(f"lane {_show(lane)}: allowed is one of {', '.join(LANES)}")
    return str(Topic(lane, check_namespace(namespace), check_robot(robot), check_stream(name)))


def parse_topic(topic: str) -> Topic:
    """Take a topic apart; raises `ContractError` for one that `build_topic` cannot have built."""
    levels = topic.split("/") if isinstance(topic, str) else []
    if len(levels) != 4:
        raise ContractError(f"topic {_show(topic)}: expected <lane>/<namespace>/<robot>/<name>")
    build_topic(levels[0], levels[2], levels[3], levels[1])
    return Topic(*levels)


def record_topic(robot: str, stream: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """Where a robot publishes its batches: straight to the rule, by Basic Ingest, which costs no
    messaging. The rule's ``topic()`` sees ``dt/<namespace>/<robot>/<stream>``."""
    topic = build_topic(RECORD, robot, stream, namespace)
    return f"$aws/rules/{rule_name('record', namespace)}/{topic}"


# --- rules, tables, metrics, PubNub --------------------------------------------------------------

# Where the broker says who came and went.
_PRESENCE = "$aws/events/presence"
RULES = ("record", "live", "pong", "echo", "upload", "presence", "version", "alert")
# A battery of three lithium cells below this is nearly empty; the deployment may say otherwise.
LOW_VOLTAGE_V = 10.5
# The files' bucket: what robots upload, and query results too large for an answer, kept for a day.
FILES_PREFIX, RESULTS_PREFIX = "robots/", "results/"

# Attributes of the telemetry and summary tables that are not the robot's own.
TOPIC, T_US, SECOND = "topic", "t", "second"
RECEIVED_MS, EXPIRES_S = "received_ms", "expires_s"
ROBOT = "robot"
# Of a robot in the registry: on which day (UTC) it has asked to upload how many bytes.
FILES_DAY, FILES_BYTES = "files_day", "files_bytes"
# And when a human was last told of what: a name for each cause, after this.
ALERT_PREFIX = "alert_"
STATS = ("min", "mean", "max", "last")
# Of a second in the summary: samples, batches they came in, batches missing before those, holes
# between samples, values that were not finite.
SAMPLES, BATCHES, MISSING_BATCHES = "n", "batches", "missing_batches"
GAPS, NONFINITE = "gaps", "nonfinite"
# Of a second that would be larger than DynamoDB's 400 KB: attributes left out, the largest first.
OMITTED = "omitted"

# The quarantine table: every message that was refused or could not be processed, by robot (`NO_ROBOT`
# where nobody can tell) and an id that follows from its content, so that the same one again is no other.
ENTRY, SOURCE, REASON, PAYLOAD = "id", "source", "reason", "payload"
FIRST_MS, LAST_MS, SEEN, REPLAYS = "first_ms", "last_ms", "seen", "replays"
NO_ROBOT = "-"
# Where it was refused: by a rule's action, by Lambda 2 or on the way to it, by another function.
BY_RULE, BY_STREAM, BY_FUNCTION = "rule", "stream", "function"
# In an event for Lambda 2: a replay, whose records are answered for and not put into quarantine again.
REPLAY = "replay"
# What a queue's message of Lambda 2's carries: the stored item as DynamoDB JSON, in base64.
ITEM_BASE64 = "base64Item"

# The registry's row of a robot, beside its vehicle parameters. Of its connection, by the broker's
# lifecycle events: times are the broker's, and the certificate is the one that it connected with.
ONLINE, LAST_SEEN_MS = "online", "last_seen_ms"
CONNECTED_MS, DISCONNECTED_MS = "connected_ms", "disconnected_ms"
DISCONNECT_REASON, CERTIFICATE_ID, AGENT_VERSION = "disconnect_reason", "certificate_id", "agent_version"
# Grows by connection, and orders the events, which may overtake each other.
SESSION_VERSION = "session_version"
PRESENCE = (
    ONLINE,
    CONNECTED_MS,
    DISCONNECTED_MS,
    LAST_SEEN_MS,
    DISCONNECT_REASON,
    CERTIFICATE_ID,
    AGENT_VERSION,
    SESSION_VERSION,
)
# Of its provisioning: the machine that has the name, until when a certificate may be issued for it and
# for which claim alone, and the certificate that was issued last.
SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM = "serial", "admit_until_s", "admit_claim"
ADMITTED_CERTIFICATE, ADMITTED_MS = "admitted_certificate", "admitted_ms"
ADMISSION = (SERIAL, ADMIT_UNTIL_S, ADMIT_CLAIM, ADMITTED_CERTIFICATE, ADMITTED_MS)
# The provisioning template's parameters.
ROBOT_PARAMETER, SERIAL_PARAMETER = "Robot", "Serial"

METRIC_NAMESPACE = "iort"
# The dimensions of every metric: the deployment's namespace and what emits it.
METRIC_DEPLOYMENT, METRIC_FUNCTION = "Deployment", "Function"
# The third of those that `robot_metrics` also counts a robot: each is billed a robot.
METRIC_ROBOT = "Robot"
METRICS = {
    "live": (
        "LivePublished",
        "LiveStale",
        "LiveRefused",
        "PubNubFailed",
        "InCarMs",
        "UplinkMs",
        "ToLambdaMs",
        "CarToLambdaMs",
    ),
    "summarize": ("BatchesSummarized", "SamplesSummarized", "BatchesRefused", "BatchesMissing"),
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


def rule_name(rule: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The physical name of a topic rule; robots need the record rule's for Basic Ingest."""
    if rule not in RULES:
        raise ContractError(f"rule {_show(rule)}: allowed is one of {', '.join(RULES)}")
    return f"{check_namespace(namespace)}_{rule}"


def rule_sql(
    rule: str,
    namespace: str = DEFAULT_NAMESPACE,
    retention_s: int = 90 * 86_400,
    low_voltage_v: float = LOW_VOLTAGE_V,
) -> str:
    """The SELECT of a topic rule. What only the cloud may say (whose message, when received, when
    it expires) comes last, so that it overrides what the message claims."""
    name = check_namespace(namespace)
    received = f"timestamp() AS {RECEIVED_MS}"
    if rule == "record":
        expires = f"floor(timestamp() / 1000) + {retention_s} AS {EXPIRES_S}"
        return f"SELECT *, topic() AS {TOPIC}, {received}, {expires} FROM '{RECORD}/{name}/+/+'"
    if rule == "live":
        return f"SELECT *, topic() AS {TOPIC}, {received} FROM '{LIVE}/{name}/+/+'"
    if rule == "pong":
        return f"SELECT *, {received} FROM '{PING}/{name}/+/{RULE}'"
    if rule == "echo":
        return f"SELECT *, topic() AS {TOPIC}, {received} FROM '{PING}/{name}/+/{LAMBDA}'"
    if rule == "upload":
        return f"SELECT *, topic() AS {TOPIC}, {received} FROM '{PING}/{name}/+/{FILE}'"
    if rule == "presence":
        return f"SELECT * FROM '{_PRESENCE}/+/+' WHERE eventType <> 'connect_failed'"
    if rule == "version":
        reported = f"state.reported.{AGENT_VERSION}"
        return (
            f"SELECT {reported} AS {AGENT_VERSION}, topic(3) AS {ROBOT} "
            f"FROM '$aws/things/+/shadow/name/{SHADOW}/update/accepted' WHERE {reported} <> ''"
        )
    if rule == "alert":
        # A controller that does not measure its voltage says 0.
        low = f"sample.voltage_input > 0 AND sample.voltage_input < {low_voltage_v:g}"
        return (
            f"SELECT t, sample.fault_code AS fault_code, sample.voltage_input AS voltage_input, "
            f"topic() AS {TOPIC}, {received} FROM '{LIVE}/{name}/+/+' "
            f"WHERE sample.fault_code > 0 OR ({low})"
        )
    raise ContractError(f"rule {_show(rule)}: allowed is one of {', '.join(RULES)}")


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
    """The name of the claims' IoT policy, and what a client id that uses a claim begins with."""
    return f"{check_namespace(namespace)}-claim"


def channel(robot: str, namespace: str = DEFAULT_NAMESPACE) -> str:
    """The PubNub channel of a robot; ``<namespace>.*`` subscribes to the whole fleet."""
    return f"{check_namespace(namespace)}.{check_robot(robot)}"


# --- the VESC's fields ---------------------------------------------------------------------------


class Field(NamedTuple):
    """One field of VescStateStamped: its unit, what it means and which driver reports it. The ROS 2
    driver's unit is ``ros2_unit`` where that is another one."""

    name: str
    unit: str
    meaning: str
    ros: tuple[int, ...]
    ros2_unit: str | None = None


# Sources: vesc_msgs/VescState.msg of the ROS 1 and the ROS 2 driver and COMM_GET_VALUES of the
# firmware. Charge and energy are in the unit the ROS 1 driver really sends, whatever its comments
# say: the integer of 1e-4 Ah and Wh straight off the wire. The ROS 2 driver divides by 1e4 first; nothing
# on the way to the tables converts either. Values that are not whole are therefore the ROS 2 driver's.
VESC_STREAM = "vesc"
VESC_FIELDS: dict[str, Field] = {
    f.name: f
    for f in (
        Field("voltage_input", "V", "battery voltage at the controller", (1, 2)),
        Field("temperature_pcb", "degC", "temperature of the controller's board", (1,)),
        Field("temp_fet", "degC", "temperature of the MOSFETs (driver may leave 0)", (2,)),
        Field("temp_motor", "degC", "temperature of the motor (driver may leave 0)", (2,)),
        Field("current_motor", "A", "motor current, negative while braking", (1, 2)),
        Field("current_input", "A", "battery current, negative while regenerating", (1, 2)),
        Field("avg_id", "A", "direct-axis current", (2,)),
        Field("avg_iq", "A", "quadrature-axis current", (2,)),
        Field("speed", "erpm", "electrical speed of the motor, revolutions per minute", (1, 2)),
        Field("duty_cycle", "1", "share of the battery voltage on the motor, -1 to 1", (1, 2)),
        Field("charge_drawn", "1e-4 Ah", "charge drawn since power-on", (1, 2), "Ah"),
        Field("charge_regen", "1e-4 Ah", "charge recovered since power-on", (1, 2), "Ah"),
        Field("energy_drawn", "1e-4 Wh", "energy drawn since power-on", (1, 2), "Wh"),
        Field("energy_regen", "1e-4 Wh", "energy recovered since power-on", (1, 2), "Wh"),
        Field("displacement", "counts", "tachometer, net", (1, 2)),
        Field("distance_traveled", "counts", "tachometer, absolute", (1, 2)),
        Field("fault_code", "enum", "0 none, otherwise see FAULTS", (1, 2)),
        Field("pid_pos_now", "deg", "rotor position of the position controller", (2,)),
        Field("controller_id", "id", "CAN id of the controller", (2,)),
        Field("ntc_temp_mos1", "degC", "temperature of MOSFET 1", (2,)),
        Field("ntc_temp_mos2", "degC", "temperature of MOSFET 2", (2,)),
        Field("ntc_temp_mos3", "degC", "temperature of MOSFET 3", (2,)),
        Field("avg_vd", "V", "direct-axis voltage", (2,)),
        Field("avg_vq", "V", "quadrature-axis voltage", (2,)),
    )
}
# The firmware's mc_fault_code, in its order: the code is the place. Its own name, which VESC Tool's logs
# have, and what it means.
_FAULTS = (
    ("NONE", "none"),
    ("OVER_VOLTAGE", "over voltage"),
    ("UNDER_VOLTAGE", "under voltage"),
    ("DRV", "gate driver (DRV8302)"),
    ("ABS_OVER_CURRENT", "absolute over-current"),
    ("OVER_TEMP_FET", "MOSFET over-temperature"),
    ("OVER_TEMP_MOTOR", "motor over-temperature"),
    ("GATE_DRIVER_OVER_VOLTAGE", "gate driver over voltage"),
    ("GATE_DRIVER_UNDER_VOLTAGE", "gate driver under voltage"),
    ("MCU_UNDER_VOLTAGE", "controller under voltage"),
    ("BOOTING_FROM_WATCHDOG_RESET", "booting from a watchdog reset"),
    ("ENCODER_SPI", "encoder SPI"),
    ("ENCODER_SINCOS_BELOW_MIN_AMPLITUDE", "sin/cos encoder below its minimum amplitude"),
    ("ENCODER_SINCOS_ABOVE_MAX_AMPLITUDE", "sin/cos encoder above its maximum amplitude"),
    ("FLASH_CORRUPTION", "flash corruption"),
    ("HIGH_OFFSET_CURRENT_SENSOR_1", "high offset of current sensor 1"),
    ("HIGH_OFFSET_CURRENT_SENSOR_2", "high offset of current sensor 2"),
    ("HIGH_OFFSET_CURRENT_SENSOR_3", "high offset of current sensor 3"),
    ("UNBALANCED_CURRENTS", "unbalanced currents"),
    ("BRK", "hardware brake input"),
    ("RESOLVER_LOT", "resolver, loss of tracking"),
    ("RESOLVER_DOS", "resolver, degradation of signal"),
    ("RESOLVER_LOS", "resolver, loss of signal"),
    ("FLASH_CORRUPTION_APP_CFG", "flash corruption, application configuration"),
    ("FLASH_CORRUPTION_MC_CFG", "flash corruption, motor configuration"),
    ("ENCODER_NO_MAGNET", "encoder without magnet"),
    ("ENCODER_MAGNET_TOO_STRONG", "encoder magnet too strong"),
    ("PHASE_FILTER", "phase filter"),
    ("ENCODER_FAULT", "encoder fault"),
    ("LV_OUTPUT_FAULT", "low-voltage output"),
    ("ENCODER_SLIP", "encoder slip"),
    ("OVERSPEED", "overspeed"),
    ("UNDERSPEED", "underspeed"),
    ("ABS_OVERSPEED", "absolute overspeed"),
)
FAULTS = {code: meaning for code, (_, meaning) in enumerate(_FAULTS)}
# Older firmware called the gate driver by its type.
FAULT_CODES = {**{name: code for code, (name, _) in enumerate(_FAULTS)}, "DRV8302": 3}
# The agent's own figures. Counts grow from 0 at its start; the offset is what to add to the car's
# clock to have the cloud's, known to within its uncertainty, and null before the first pong.
AGENT_FIELDS = {
    "cpu_percent": "% of one core, since the sample before",
    "rss_mb": "MB of memory in use",
    "samples_per_s": "samples/s from all sources, since the sample before",
    "backlog_batches": "batches in the spool",
    "backlog_bytes": "bytes in the spool",
    "dropped_batches": "batches dropped because the spool was full",
    "connects": "connections made",
    "clock_offset_ms": "ms, cloud minus car",
    "clock_uncertainty_ms": "ms, either way",
    "files_waiting": "files waiting to be uploaded",
    "files_sent_bytes": "bytes of files sent",
}
# Derived in the summary from the vehicle's parameters (robots table) and the fields above.
DERIVED_UNITS = {"speed_mps": "m/s", "power_w": "W"}


# --- record lane: the batch envelope ---------------------------------------------------------------

CODEC = "columns+zlib+base64"


@dataclass(frozen=True)
class Batch:
    """Consecutive samples of one stream.

    ``boot`` names the agent's run; ``seq`` numbers the stream's batches without a hole, across
    restarts where the spool is durable; ``times_us`` are microseconds since the epoch, one a sample,
    strictly increasing and within `MAX_BATCH_SPAN_US`; ``columns`` holds a list of equal length a
    field; ``nonfinite`` counts the NaNs and infinities that became None.
    """

    boot: str
    seq: int
    times_us: Sequence[int]
    columns: Mapping[str, Sequence[Value]]
    nonfinite: int = 0

    @property
    def t_us(self) -> int:
        """The first sample's time, which is the stored item's sort key."""
        return self.times_us[0]


def encode(batch: Batch) -> bytes:
    """The envelope as JSON. NaN and infinities become null and are added to ``nonfinite``.

    Raises `ContractError` where the batch is not allowed; a batch too large for one message is
    encoded all the same: compare with `MAX_MESSAGE_BYTES` and use `split`.
    """
    _check_header(batch.boot, batch.seq, batch.nonfinite)
    times, n = batch.times_us, len(batch.times_us)
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"batch of {n} samples: allowed is 1 to {MAX_SAMPLES}")
    if len(batch.columns) > MAX_FIELDS:
        raise ContractError(f"batch of {len(batch.columns)} fields: allowed is up to {MAX_FIELDS}")
    nonfinite = batch.nonfinite
    fields: dict[str, list[Value]] = {}
    for name, column in batch.columns.items():
        _checked(_FIELD, name, "field name", "a ROS field name or a dotted path of them")
        if len(column) != n:
            raise ContractError(f"field {name}: {len(column)} values for {n} samples")
        fields[name], nulled = _wire_column(name, column)
        nonfinite += nulled
    _check_header(batch.boot, batch.seq, nonfinite)
    _check_times(times)
    dt = [0] + [b - a for a, b in zip(times, times[1:])]
    text = json.dumps({"dt": dt, "fields": fields}, separators=(",", ":"), allow_nan=False)
    if len(text) > MAX_COLUMNS_BYTES:
        raise ContractError(f"batch of {len(text)} bytes of columns: allowed is up to {MAX_COLUMNS_BYTES}")
    samples = base64.b64encode(zlib.compress(text.encode(), 6)).decode()
    envelope = {
        "v": SCHEMA_VERSION,
        "boot": batch.boot,
        "seq": batch.seq,
        T_US: times[0],
        SAMPLES: n,
        NONFINITE: nonfinite,
        "codec": CODEC,
        "samples": samples,
    }
    return json.dumps(envelope, separators=(",", ":")).encode()


def decode(message: bytes | str | Mapping[str, Any]) -> Batch:
    """The batch in an envelope: the message as sent, or the attributes of a stored item.

    Raises `ContractError`, naming what is wrong, for anything that `encode` cannot have written.
    """
    envelope = message if isinstance(message, Mapping) else _json_object(message, "envelope")
    _check_version(envelope)
    if envelope.get("codec") != CODEC:
        raise ContractError(f"codec {_show(envelope.get('codec'))}: this side knows {CODEC}")
    seq = _integer(envelope, "seq")
    first_us, n = _integer(envelope, T_US), _integer(envelope, SAMPLES)
    nonfinite = _integer(envelope, NONFINITE)
    boot = _check_header(envelope.get("boot"), seq, nonfinite)
    if not 1 <= n <= MAX_SAMPLES:
        raise ContractError(f"envelope says {n} samples: allowed is 1 to {MAX_SAMPLES}")
    body = _json_object(inflate(envelope.get("samples")), "samples")
    dt, fields = body.get("dt"), body.get("fields")
    if not isinstance(dt, list) or len(dt) != n or not isinstance(fields, dict):
        raise ContractError(f"samples: expected {n} dt and an object of fields")
    if len(fields) > MAX_FIELDS:
        raise ContractError(f"samples of {len(fields)} fields: allowed is up to {MAX_FIELDS}")
    if dt[0] != 0 or not set(map(type, dt)) <= {int}:
        raise ContractError("samples: dt must be integers, the first 0")
    for name, column in fields.items():
        _checked(_FIELD, name, "field name", "a ROS field name or a dotted path of them")
        if not isinstance(column, list) or len(column) != n:
            raise ContractError(f"field {name}: expected {n} values")
        if _wire_column(name, column)[1]:
            raise ContractError(f"field {name}: a number is not finite")
    times = list(accumulate(dt, initial=first_us))[1:]
    _check_times(times)
    return Batch(boot, seq, times, fields, nonfinite)


def decode_item(item: Mapping[str, Any]) -> tuple[Topic, Batch]:
    """Whose a stored item is, and its batch.

    Raises `ContractError` for one that is no batch, that is not of the record lane, whose body names
    another robot than its topic, or whose time is before 1970 or `MAX_AHEAD_US` after its receipt.
    """
    topic = parse_topic(item[TOPIC]) if TOPIC in item else None
    if topic is None or topic.lane != RECORD:
        raise ContractError(f"topic {_show(item.get(TOPIC))}: expected {RECORD}/<namespace>/<robot>/<stream>")
    if item.get(ROBOT, topic.robot) != topic.robot:
        raise ContractError(f"sent by {topic.robot} in the name of {_show(item[ROBOT])}")
    batch = decode(item)
    if batch.t_us < 0:
        raise ContractError(f"time {batch.t_us} us: before 1970")
    if RECEIVED_MS in item and batch.t_us > _integer(item, RECEIVED_MS) * 1000 + MAX_AHEAD_US:
        raise ContractError(f"time {batch.t_us} us: over a year after its receipt; the car's clock is wrong")
    return topic, batch


def split(batch: Batch) -> tuple[Batch, Batch]:
    """The two halves of a batch, the second with the next ``seq``.

    Raises `ContractError` for a single sample, which cannot be made smaller.
    """
    half = len(batch.times_us) // 2
    if half == 0:
        raise ContractError(f"one sample of {len(batch.columns)} fields does not fit in a message")
    first = {name: column[:half] for name, column in batch.columns.items()}
    second = {name: column[half:] for name, column in batch.columns.items()}
    return (
        Batch(batch.boot, batch.seq, batch.times_us[:half], first, batch.nonfinite),
        Batch(batch.boot, batch.seq + 1, batch.times_us[half:], second, 0),
    )


# --- message types ---------------------------------------------------------------------------------

# A definition is a text of its own, in pieces that a field may hold.
_PIECE, _MAX_PIECES = 4000, 64


class MessageType(NamedTuple):
    """The ROS 1 type of the messages that a stream's samples are made of.

    A source says it once a run, as a sample of the stream `TYPES_STREAM`: from then on downstream knows
    how to make the messages again. ``kind`` is as ROS 1 writes it, ``package/Type``; ``definition`` is the
    text that a publisher sends and a bag keeps, with every type within.
    """

    stream: str
    topic: str
    kind: str
    md5sum: str
    definition: str

    def sample(self) -> dict[str, Value]:
        """The type as a sample. Raises `ContractError` for a definition that is too long."""
        pieces = [self.definition[i : i + _PIECE] for i in range(0, len(self.definition), _PIECE)]
        if len(pieces) > _MAX_PIECES:
            raise ContractError(f"the definition of {self.kind} has over {_PIECE * _MAX_PIECES} characters")
        sample: dict[str, Value] = dict(self._asdict())
        del sample["definition"]
        sample.update({f"definition.{i}": piece for i, piece in enumerate(pieces)})
        return sample


def message_type(sample: Mapping[str, Value]) -> MessageType:
    """The type in a sample; raises `ContractError` for what `MessageType.sample` cannot have written."""
    texts = {name: value for name, value in sample.items() if isinstance(value, str)}
    try:
        stream, topic, kind, md5sum = (texts[name] for name in ("stream", "topic", "kind", "md5sum"))
        pieces = [texts[f"definition.{i}"] for i in range(sum("definition." in name for name in texts))]
    except KeyError as error:
        raise ContractError(f"a message type without {error}") from error
    return MessageType(stream, topic, kind, md5sum, "".join(pieces))


# --- live lane, pings ------------------------------------------------------------------------------


@dataclass(frozen=True)
class LiveSample:
    """The newest sample of a stream, as the live lane carries it.

    ``seq`` numbers the run's live messages; ``t_us`` is the sample's time, ``sent_us`` the time it
    left the car; ``sample`` maps field to value. Fields stand in an object of their own, so that no
    ROS field can be taken for one of ours; a rule filters on ``sample.fault_code``. ``offset_us`` is what
    to add to the car's clock to have the cloud's, where the car knows it to within
    `CLOCK_MAX_UNCERTAINTY_MS`.
    """

    boot: str
    seq: int
    t_us: int
    sent_us: int
    sample: Mapping[str, Value]
    nonfinite: int = 0
    offset_us: int | None = None


def encode_live(live: LiveSample) -> bytes:
    """The live message as JSON; NaN and infinities become null and are counted."""
    _check_header(live.boot, live.seq, live.nonfinite)
    if len(live.sample) > MAX_FIELDS:
        raise ContractError(f"sample of {len(live.sample)} fields: allowed is up to {MAX_FIELDS}")
    sample, nulled = _wire_sample(live.sample)
    nonfinite = live.nonfinite + nulled
    _check_header(live.boot, live.seq, nonfinite)
    message = {
        "v": SCHEMA_VERSION,
        "boot": live.boot,
        "seq": live.seq,
        T_US: _check_time(live.t_us, "sample time"),
        "sent_us": _check_time(live.sent_us, "sent_us"),
        NONFINITE: nonfinite,
        **_offset_us(live.offset_us),
        "sample": sample,
    }
    return _COMPACT.encode(message).encode()


def decode_live(message: bytes | str | Mapping[str, Any]) -> LiveSample:
    """The sample in a live message; raises `ContractError` for what `encode_live` cannot write."""
    envelope = message if isinstance(message, Mapping) else _json_object(message, "live message")
    _check_version(envelope)
    seq, nonfinite = _integer(envelope, "seq"), _integer(envelope, NONFINITE)
    boot = _check_header(envelope.get("boot"), seq, nonfinite)
    sample = envelope.get("sample")
    if not isinstance(sample, dict) or len(sample) > MAX_FIELDS:
        raise ContractError(f"sample: expected an object of up to {MAX_FIELDS} fields")
    for name, value in sample.items():
        _checked(_FIELD, name, "field name", "a ROS field name or a dotted path of them")
        if _wire_column(name, (value,))[1]:
            raise ContractError(f"field {name}: the number is not finite")
    t_us = _check_time(_integer(envelope, T_US), "sample time")
    sent_us = _check_time(_integer(envelope, "sent_us"), "sent_us")
    offset_us = _integer(envelope, "offset_us") if "offset_us" in envelope else None
    _offset_us(offset_us)
    return LiveSample(boot, seq, t_us, sent_us, sample, nonfinite, offset_us)


def live_update(
    robot: str, stream: str, live: LiveSample, received_ms: int, lambda_us: int
) -> dict[str, Any]:
    """What Lambda 1 sends to PubNub: the sample, the time of every hop it has passed and, where the car
    knows it, what to add to the car's times to have the cloud's."""
    hops = {"sent_us": live.sent_us, RECEIVED_MS: received_ms, "lambda_us": lambda_us}
    return {
        "v": SCHEMA_VERSION,
        ROBOT: robot,
        "stream": stream,
        "boot": live.boot,
        "seq": live.seq,
        T_US: live.t_us,
        "hops": {**hops, **_offset_us(live.offset_us)},
        "sample": dict(live.sample),
    }


def encode_ping(ping_id: int, sent_us: int, padding: str = "") -> bytes:
    """A ping; the pong has the same content, and the cloud's ``received_ms``."""
    if type(ping_id) is not int or not 0 <= ping_id <= _MAX_SEQ:
        raise ContractError(f"ping id {_show(ping_id)}: allowed is an integer from 0")
    ping: dict[str, Any] = {"v": SCHEMA_VERSION, "id": ping_id}
    ping["sent_us"] = _check_time(sent_us, "sent_us")
    if padding:
        ping["padding"] = padding
    return json.dumps(ping, separators=(",", ":")).encode()


class Pong(NamedTuple):
    """The answer to a ping; ``received_ms`` is None on the broker path, which the cloud never sees."""

    id: int
    sent_us: int
    received_ms: int | None


def decode_pong(message: bytes | str) -> Pong:
    """Read a pong, or a ping that came straight back; raises `ContractError` otherwise."""
    envelope = _json_object(message, "pong")
    received = _integer(envelope, RECEIVED_MS) if RECEIVED_MS in envelope else None
    return Pong(_integer(envelope, "id"), _integer(envelope, "sent_us"), received)


# --- commands, and what robots tell each other ------------------------------------------------------

# However long an operator asks for: a command is for now, and a motion must not go on by itself.
MAX_VALID_MS, MAX_LEASE_MS = 60_000, 10_000
# A message for others to act on is worth nothing later; LIVE_MAX_AGE_MS is for eyes.
FLEET_MAX_AGE_MS = 2_000


@dataclass(frozen=True)
class Command:
    """A ROS message for a robot to publish.

    Commands are in the order of ``started_us``, ``session``, ``seq``: ``session`` names an operator's
    session, which began at ``started_us``, and ``seq`` numbers its commands; a later session takes
    over. After ``valid_ms`` from ``sent_us``, by the cloud's clock, the command is stale. ``lease_ms``,
    without which a motion is refused, is how long it may go on until the next one. ``message`` is the
    ROS message. With ``answer`` the robot says in its shadow what became of it: `COMMANDS`, name,
    ``session``, ``seq`` and ``outcome``, `ACCEPTED` or why not.
    """

    session: str
    started_us: int
    seq: int
    sent_us: int
    valid_ms: int
    message: Mapping[str, Any]
    lease_ms: int | None = None
    answer: bool = False

    @property
    def order(self) -> tuple[int, str, int]:
        """What of two commands the later one has more of."""
        return (self.started_us, self.session, self.seq)


def encode_command(command: Command) -> bytes:
    """The command as JSON. Raises `ContractError` for one that is not allowed."""
    _check_command(command)
    envelope: dict[str, Any] = {
        "v": SCHEMA_VERSION,
        "session": command.session,
        "started_us": command.started_us,
        "seq": command.seq,
        "sent_us": command.sent_us,
        "valid_ms": command.valid_ms,
    }
    if command.lease_ms is not None:
        envelope["lease_ms"] = command.lease_ms
    if command.answer:
        envelope["answer"] = True
    return _message_json({**envelope, "message": command.message})


def decode_command(payload: bytes | str) -> Command:
    """Read a command; raises `ContractError` for what `encode_command` cannot have written."""
    envelope = _message_envelope(payload, "command")
    command = Command(
        session=envelope.get("session"),  # type: ignore[arg-type]
        started_us=_integer(envelope, "started_us"),
        seq=_integer(envelope, "seq"),
        sent_us=_integer(envelope, "sent_us"),
        valid_ms=_integer(envelope, "valid_ms"),
        message=envelope["message"],
        lease_ms=_integer(envelope, "lease_ms") if "lease_ms" in envelope else None,
        answer=envelope.get("answer", False),
    )
    _check_command(command)
    return command


@dataclass(frozen=True)
class FleetMessage:
    """A robot's ROS message for other robots: the newest only, ``seq`` growing within a ``boot``.
    ``offset_us`` is what to add to ``sent_us`` to have the cloud's time, where the robot knows it."""

    boot: str
    seq: int
    sent_us: int
    message: Mapping[str, Any]
    offset_us: int | None = None


def encode_fleet(fleet: FleetMessage) -> bytes:
    """The message as JSON. Raises `ContractError` for one that is not allowed."""
    envelope = {
        "v": SCHEMA_VERSION,
        "boot": _check_header(fleet.boot, fleet.seq, 0),
        "seq": fleet.seq,
        "sent_us": _check_time(fleet.sent_us, "sent_us"),
        **_offset_us(fleet.offset_us),
    }
    return _message_json({**envelope, "message": fleet.message})


def decode_fleet(payload: bytes | str) -> FleetMessage:
    """Read another robot's message; raises `ContractError` for what `encode_fleet` cannot write."""
    envelope = _message_envelope(payload, "fleet message")
    seq = _integer(envelope, "seq")
    boot = _check_header(envelope.get("boot"), seq, 0)
    sent_us = _check_time(_integer(envelope, "sent_us"), "sent_us")
    offset_us = _integer(envelope, "offset_us") if "offset_us" in envelope else None
    _offset_us(offset_us)
    return FleetMessage(boot, seq, sent_us, envelope["message"], offset_us)


def _check_command(command: Command) -> None:
    _checked(_BOOT, command.session, "session", "8 to 32 of 0-9 a-f")
    _check_header(command.session, command.seq, 0)
    if not isinstance(command.answer, bool):
        raise ContractError(f"answer {_show(command.answer)}: allowed is true or false")
    if _check_time(command.started_us, "started_us") > _check_time(command.sent_us, "sent_us"):
        raise ContractError("the command was sent before its session started")
    for name, value, most in (
        ("valid_ms", command.valid_ms, MAX_VALID_MS),
        ("lease_ms", command.lease_ms, MAX_LEASE_MS),
    ):
        if value is None and name == "lease_ms":
            continue
        if type(value) is not int or not 1 <= value <= most:
            raise ContractError(f"{name} {_show(value)}: allowed is an integer from 1 to {most}")


def _message_json(envelope: Mapping[str, Any]) -> bytes:
    if not isinstance(envelope["message"], dict):
        raise ContractError(f"message {_show(envelope['message'])}: expected an object")
    try:
        payload = json.dumps(envelope, separators=(",", ":"), allow_nan=False).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ContractError(f"the message is not JSON: {error}") from error
    if len(payload) > MAX_MESSAGE_BYTES:
        raise ContractError(f"the message would have {len(payload)} of {MAX_MESSAGE_BYTES} bytes")
    return payload


def _message_envelope(payload: bytes | str, what: str) -> dict[str, Any]:
    envelope = _json_object(payload, what)
    _check_version(envelope)
    if not isinstance(envelope.get("message"), dict):
        raise ContractError(f"message {_show(envelope.get('message'))}: expected an object")
    return envelope


# --- files --------------------------------------------------------------------------------------------

# S3 takes parts of 5 MiB and more, up to 10,000 of them, and SHA-256 of each part.
PART_BYTES = 8 * 1024 * 1024
MAX_FILE_BYTES = 64 * 1024**3
# A signed address takes 2 KB, most of it the function's session.
MAX_ADDRESSES = 16
UPLOAD_URL_S = 900
KINDS = ("recording", "image", "log", "message", "other")

# What stands in a sample for a field that is too large for a message, as <field>.<one of these>: the
# claim check. All are null where the content was not kept, and the thumbnail where there is none.
CLAIM_FIELDS = {
    "key": "where the content is, or will be, in the files' bucket",
    "sha256": "of the content, in hex",
    "size": "bytes of content",
    "content_type": "of the content",
    "thumbnail": "of an image: base64 of a small JPEG",
}

_FILE_LEVEL = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"
_FILE_NAME = re.compile(rf"{_FILE_LEVEL}(/{_FILE_LEVEL}){{0,3}}")
_CONTENT_TYPE = re.compile(r"[a-z0-9.+-]{1,50}/[a-z0-9.+-]{1,50}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MAX_WAIT_S = 86_400


@dataclass(frozen=True)
class File:
    """A file that a robot has: its name (up to four levels), one of `KINDS`, its content type and size,
    the SHA-256 of its content in hex, and the time it was last written, microseconds since the epoch."""

    name: str
    kind: str
    content_type: str
    size: int
    sha256: str
    t_us: int

    @property
    def parts(self) -> int:
        """Of how many parts the upload is: 1 for a file that goes in one piece."""
        return max(1, -(-self.size // PART_BYTES))


@dataclass(frozen=True)
class FileRequest:
    """Asks where a file may be uploaded to, and says at the end that it is.

    ``id`` names the request, the answer repeats it. ``parts`` maps number (from 1) to SHA-256 of those
    parts whose addresses are wanted, at most `MAX_ADDRESSES`; a file of one part names that. ``parts_sha256``
    says that all parts are there: it is the SHA-256 of their SHA-256, one after the other.
    """

    id: str
    file: File
    parts: Mapping[int, str]
    parts_sha256: str | None = None


class Address(NamedTuple):
    """Where to PUT a part (or the file, if it has but one), with exactly these headers."""

    part: int
    url: str
    headers: Mapping[str, str]


@dataclass(frozen=True)
class FileAnswer:
    """``stored``: the bucket has it, under ``key``. Otherwise ``addresses`` of what it lacks, and
    ``have``, the ranges (first, last) of parts that it has. ``refused`` says why there are none, and
    ``again_s`` after how many seconds it is worth to ask again; None: never."""

    id: str
    key: str | None = None
    stored: bool = False
    have: Sequence[tuple[int, int]] = ()
    addresses: Sequence[Address] = ()
    refused: str | None = None
    again_s: int | None = None


def file_key(robot: str, file: File) -> str:
    """The key of a robot's file in the bucket. It follows from the file alone, so that robot and cloud
    need not tell each other, and it names the content, so that no other content can have it."""
    moment = time.gmtime(_check_file(file).t_us // 1_000_000)
    day, second = time.strftime("%Y/%m/%d", moment), time.strftime("%H%M%S", moment)
    return f"{FILES_PREFIX}{check_robot(robot)}/{day}/{second}-{file.sha256[:12]}/{file.name}"


class FileKey(NamedTuple):
    """What a key says of its file: whose it is, the second it was last written (since the epoch), the
    first 12 digits of its SHA-256, and its name."""

    robot: str
    second: int
    digits: str
    name: str


_FILE_KEY = re.compile(
    rf"{FILES_PREFIX}([^/]+)/(\d{{4}}/\d\d/\d\d/\d{{6}})-([0-9a-f]{{12}})/({_FILE_LEVEL}(?:/{_FILE_LEVEL}){{0,3}})"
)


def parse_file_key(key: str) -> FileKey:
    """Take a key apart; raises `ContractError` for one that `file_key` cannot have built."""
    match = _FILE_KEY.fullmatch(key)
    if match is None:
        raise ContractError(f"key {_show(key)}: expected {FILES_PREFIX}<robot>/<day>/<time>-<hash>/<name>")
    robot, when, digits, name = match.groups()
    try:
        second = calendar.timegm(time.strptime(when, "%Y/%m/%d/%H%M%S"))
    except ValueError as error:
        raise ContractError(f"key {_show(key)}: {when} is no time") from error
    return FileKey(check_robot(robot), second, digits, name)


def part_range(file: File, part: int) -> tuple[int, int]:
    """Where a part begins in its file, and its size; raises `ContractError` for one that it does not have."""
    if type(part) is not int or not 1 <= part <= file.parts:
        raise ContractError(f"part {_show(part)}: allowed is 1 to {file.parts}")
    first = (part - 1) * PART_BYTES
    return first, min(PART_BYTES, file.size - first)


def encode_file_request(request: FileRequest) -> bytes:
    """The request as JSON. Raises `ContractError` for one that is not allowed."""
    _check_file_request(request)
    file = request.file
    envelope: dict[str, Any] = {
        "v": SCHEMA_VERSION,
        "id": request.id,
        "file": {
            "name": file.name,
            "kind": file.kind,
            "content_type": file.content_type,
            "size": file.size,
            "sha256": file.sha256,
            T_US: file.t_us,
        },
        "parts": {str(part): sha256 for part, sha256 in request.parts.items()},
    }
    if request.parts_sha256 is not None:
        envelope["parts_sha256"] = request.parts_sha256
    return json.dumps(envelope, separators=(",", ":")).encode()


def decode_file_request(message: bytes | str | Mapping[str, Any]) -> FileRequest:
    """Read a request; raises `ContractError` for what `encode_file_request` cannot have written."""
    envelope = message if isinstance(message, Mapping) else _json_object(message, "file request")
    _check_version(envelope)
    given, parts = envelope.get("file"), envelope.get("parts")
    if not isinstance(given, Mapping) or not isinstance(parts, Mapping):
        raise ContractError("file and parts: expected an object each")
    file = File(
        name=given.get("name"),  # type: ignore[arg-type]
        kind=given.get("kind"),  # type: ignore[arg-type]
        content_type=given.get("content_type"),  # type: ignore[arg-type]
        size=_integer(given, "size"),
        sha256=given.get("sha256"),  # type: ignore[arg-type]
        t_us=_integer(given, T_US),
    )
    numbered = {int(n) if str(n).isdecimal() and len(str(n)) < 6 else -1: sha for n, sha in parts.items()}
    request = FileRequest(envelope.get("id"), file, numbered, envelope.get("parts_sha256"))  # type: ignore[arg-type]
    _check_file_request(request)
    return request


def encode_file_answer(answer: FileAnswer) -> bytes:
    """The answer as JSON, without what it does not say."""
    envelope: dict[str, Any] = {"v": SCHEMA_VERSION, "id": answer.id}
    if answer.refused is not None:
        envelope["refused"] = answer.refused
        if answer.again_s is not None:
            envelope["again_s"] = answer.again_s
    else:
        envelope.update(key=answer.key, stored=answer.stored)
    if answer.have:
        envelope["have"] = [list(one) for one in answer.have]
    if answer.addresses:
        envelope["addresses"] = [one._asdict() for one in answer.addresses]
    return json.dumps(envelope, separators=(",", ":")).encode()


def decode_file_answer(message: bytes | str) -> FileAnswer:
    """Read an answer; raises `ContractError` for what `encode_file_answer` cannot have written."""
    envelope = _json_object(message, "file answer")
    _check_version(envelope)
    given_id = _checked(_BOOT, envelope.get("id"), "id", "8 to 32 of 0-9 a-f")  # type: ignore[arg-type]
    if "refused" in envelope:
        again_s = _integer(envelope, "again_s") if "again_s" in envelope else None
        if again_s is not None and not 0 <= again_s <= _MAX_WAIT_S:
            raise ContractError(f"again_s {again_s}: allowed is 0 to {_MAX_WAIT_S}")
        return FileAnswer(given_id, refused=str(envelope["refused"]), again_s=again_s)
    key, stored = envelope.get("key"), envelope.get("stored")
    if not isinstance(key, str) or not isinstance(stored, bool):
        raise ContractError("key and stored: expected a text, and true or false")
    try:
        have = tuple((int(first), int(last)) for first, last in envelope.get("have", ()))
        addresses = tuple(
            Address(int(one["part"]), str(one["url"]), {str(k): str(v) for k, v in one["headers"].items()})
            for one in envelope.get("addresses", ())
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ContractError(f"have or addresses are not what they should be: {error}") from error
    return FileAnswer(given_id, key, stored, have, addresses)


def _check_file_request(request: FileRequest) -> None:
    _checked(_BOOT, request.id, "id", "8 to 32 of 0-9 a-f")
    file = _check_file(request.file)
    if len(request.parts) > MAX_ADDRESSES:
        raise ContractError(f"{len(request.parts)} parts asked for: allowed is up to {MAX_ADDRESSES}")
    for part, sha256 in request.parts.items():
        part_range(file, part)
        _checked(_SHA256, sha256, f"SHA-256 of part {part}", "64 of 0-9 a-f")
    if request.parts_sha256 is not None:
        _checked(_SHA256, request.parts_sha256, "parts_sha256", "64 of 0-9 a-f")


def _check_file(file: File) -> File:
    _checked(_FILE_NAME, file.name, "file name", "up to 4 levels of A-Z a-z 0-9 . _ -, up to 100 each")
    if file.kind not in KINDS:
        raise ContractError(f"kind {_show(file.kind)}: allowed is one of {', '.join(KINDS)}")
    _checked(_CONTENT_TYPE, file.content_type, "content type", "type/subtype in lower case")
    _checked(_SHA256, file.sha256, "SHA-256", "64 of 0-9 a-f")
    if type(file.size) is not int or not 0 <= file.size <= MAX_FILE_BYTES:
        raise ContractError(f"size {_show(file.size)}: allowed is 0 to {MAX_FILE_BYTES} bytes")
    if _check_time(file.t_us, "file time") < 0:
        raise ContractError(f"file time {file.t_us}: allowed is from 1970 on")
    return file


# --- the checks beneath ----------------------------------------------------------------------------

_BOOT = re.compile(r"[0-9a-f]{8,32}")
_MAX_SEQ = 2**53
# Microseconds within +-285 years of the epoch: what a JavaScript number holds exactly.
_MAX_TIME_US = 2**53
_PLAIN = {int, float, bool, str, type(None)}
_MAX_INT, _MIN_INT, _MAX_TEXT = 2**64 - 1, -(2**63), 4096


def _wire_column(name: str, column: Sequence[Any]) -> tuple[list[Value], int]:
    """The column with None for what is not finite and integers for whole floats; how many nulled."""
    kinds = set(map(type, column))
    if not kinds <= _PLAIN:
        odd = next(value for value in column if type(value) not in _PLAIN)
        raise ContractError(f"field {name}: {_show(odd)} is neither number, text, true, false nor null")
    nulled = 0
    out: list[Value] = list(column)
    # Whole columns are looked at in C where they hold one kind; a car and Lambda 2 do this for every batch.
    if kinds == {int} and min(column) >= _MIN_INT and max(column) <= _MAX_INT:
        return out, 0
    if kinds == {float} and all(map(math.isfinite, column)) and not any(map(float.is_integer, column)):
        return out, 0
    if float in kinds:
        for i, value in enumerate(out):
            if type(value) is float:
                if not math.isfinite(value):
                    out[i] = None
                    nulled += 1
                elif value.is_integer() and -(2.0**53) < value < 2.0**53:
                    out[i] = int(value)
    if int in kinds and any(type(v) is int and not _MIN_INT <= v <= _MAX_INT for v in out):
        raise ContractError(f"field {name}: an integer does not fit in 64 bits")
    if str in kinds and any(type(v) is str and not _is_text(v) for v in out):
        raise ContractError(f"field {name}: a text is over {_MAX_TEXT} characters or not Unicode")
    return out, nulled


# Made once: json.dumps makes one a call, which costs as much as the message.
_COMPACT = json.JSONEncoder(separators=(",", ":"), allow_nan=False)


def _wire_sample(sample: Mapping[str, Any]) -> tuple[dict[str, Value], int]:
    """As `_wire_column`, of one value a field; all at once, for this is the live lane's way."""
    for name in sample:
        _field_name(name)
    try:
        values, nulled = _wire_column("", list(sample.values()))
    except ContractError:
        for name, value in sample.items():
            _wire_column(name, (value,))
        raise
    return dict(zip(sample, values)), nulled


@lru_cache(maxsize=4096)
def _field_name(name: str) -> str:
    return _checked(_FIELD, name, "field name", "a ROS field name or a dotted path of them")


def _is_text(value: str) -> bool:
    return len(value) <= _MAX_TEXT and not any(0xD800 <= ord(c) <= 0xDFFF for c in value)


def _check_version(envelope: Mapping[str, Any]) -> None:
    version = _integer(envelope, "v")
    if version != SCHEMA_VERSION:
        raise ContractError(f"schema version {version}: this side knows {SCHEMA_VERSION}")


def _check_header(boot: Any, seq: Any, nonfinite: Any) -> str:
    if not isinstance(boot, str) or not _BOOT.fullmatch(boot):
        raise ContractError(f"boot {_show(boot)}: allowed is 8 to 32 of 0-9 a-f")
    if type(seq) is not int or not 0 <= seq <= _MAX_SEQ:
        raise ContractError(f"seq {_show(seq)}: allowed is an integer from 0")
    if type(nonfinite) is not int or not 0 <= nonfinite <= MAX_SAMPLES * MAX_FIELDS:
        raise ContractError(f"{NONFINITE} {_show(nonfinite)}: allowed is an integer from 0")
    return boot


def _check_time(t_us: Any, what: str) -> int:
    if type(t_us) is not int or not -_MAX_TIME_US < t_us < _MAX_TIME_US:
        raise ContractError(f"{what} {_show(t_us)}: allowed is whole microseconds since the epoch")
    return t_us


def _offset_us(offset_us: Any) -> dict[str, int]:
    return {} if offset_us is None else {"offset_us": _check_time(offset_us, "offset_us")}


def _check_times(times_us: Sequence[int]) -> None:
    for t_us in times_us:
        _check_time(t_us, "sample time")
    if any(b <= a for a, b in zip(times_us, times_us[1:])):
        raise ContractError("sample times must strictly increase within a batch")
    if times_us[-1] - times_us[0] >= MAX_BATCH_SPAN_US:
        raise ContractError(f"a batch must span less than {MAX_BATCH_SPAN_US} microseconds")


def _integer(envelope: Mapping[str, Any], key: str) -> int:
    value: Any = envelope.get(key)
    try:
        # Numbers of a stored item arrive as Decimal, which compares equal to the integer it holds.
        # The bounds come first: the integer of Decimal("1E+999999") is a megabyte of digits.
        if not isinstance(value, bool) and _MIN_INT <= value <= _MAX_INT:
            integer = int(value)
            if integer == value:
                return integer
    except (TypeError, ValueError, ArithmeticError) as error:
        raise ContractError(f"{key} {_show(value)}: expected an integer") from error
    raise ContractError(f"{key} {_show(value)}: expected an integer")


def inflate(samples: Any) -> bytes:
    """The JSON of a batch's columns, as large as a batch may be and no larger; raises `ContractError`."""
    if not isinstance(samples, (str, bytes)):
        raise ContractError(f"samples {_show(samples)}: expected base64 text")
    try:
        packed = base64.b64decode(samples, validate=True)
        inflater = zlib.decompressobj()
        body = inflater.decompress(packed, MAX_COLUMNS_BYTES + 1)
    except (binascii.Error, ValueError, zlib.error) as error:
        raise ContractError(f"samples are not base64 of zlib: {error}") from error
    if len(body) > MAX_COLUMNS_BYTES:
        raise ContractError(f"samples inflate to over {MAX_COLUMNS_BYTES} bytes")
    if not inflater.eof or inflater.unused_data:
        raise ContractError("samples are cut short, or more follows them")
    return body


def _json_object(text: Any, what: str) -> dict[str, Any]:
    try:
        value = json.loads(text, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ContractError(f"{what} is nested too deeply") from error
    except (TypeError, ValueError) as error:
        raise ContractError(f"{what} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise ContractError(f"{what} is not a JSON object")
    return value


def _refuse_constant(name: str) -> None:
    raise ContractError(f"{name} is not JSON")


def _show(value: Any) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, a list within lists
        text = f"<{type(value).__name__}>"
    return text if len(text) <= 60 else text[:57] + "..."
