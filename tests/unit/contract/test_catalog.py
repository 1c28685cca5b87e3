"""Rules and metrics: the cloud's rules select the topics on which the robots publish."""

from __future__ import annotations

import json
import re

import pytest

from iort_contract.catalog import metrics
from iort_contract.catalog.environments import (
    AlertEnvironment,
    LaterEnvironment,
    LiveEnvironment,
    UploadEnvironment,
)
from iort_contract.catalog.metrics import METRICS, ROBOT_CHARTS
from iort_contract.catalog.rules import RULES
from iort_contract.catalog.vesc import FAULT_CODES, FAULTS, VESC_FIELDS, absent
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.live import LEASE, encode_ping
from iort_contract.tables import ENVELOPE, EXPIRES_S, MESSAGE_BASE64, PING_FIELDS, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import (
    ANSWER,
    ASK,
    BROKER,
    CMD,
    FILE,
    FLEET,
    LAMBDA,
    LANES,
    LIVE,
    PING,
    PONG,
    RECORD,
    RULE,
    SHADOW,
    VIEW,
    build_topic,
)


def matches(pattern, topic):
    """MQTT's wildcards, without ``#``, which no rule of ours uses."""
    levels, wanted = topic.split("/"), pattern.split("/")
    return len(levels) == len(wanted) and all(map(lambda w, level: w in ("+", level), wanted, levels))


# By lane and name of a robot's topic: the rules that select it.
SELECTED_BY = {
    (RECORD, "vesc"): {"record"},
    (LIVE, "vesc"): {"live", "fault", "battery"},
    (PING, RULE): {"pong"},
    (PING, LAMBDA): {"echo"},
    (PING, FILE): {"upload"},
    (PING, BROKER): set(),
    **{(PONG, path): set() for path in (RULE, LAMBDA, FILE)},
    (ASK, "calibration"): {"ask"},
    (ANSWER, "calibration"): set(),
    (FLEET, "pose"): set(),
    (CMD, "stop"): set(),
    (VIEW, LEASE): set(),
}


@pytest.mark.parametrize("namespace", ["iort", "stage2"])
def test_a_topic_is_selected_by_exactly_its_rules(namespace):
    patterns = {
        name: re.findall(r"FROM '([^']*)'", rule.statement(namespace))[0] for name, rule in RULES.items()
    }
    expected = {
        **{build_topic(lane, "car", name, namespace): rules for (lane, name), rules in SELECTED_BY.items()},
        **{build_topic(lane, "car", name, "other"): set() for lane, name in SELECTED_BY},
        "$aws/events/presence/connected/car": {"presence"},
        "$aws/events/presence/disconnected/car": {"presence"},
        f"$aws/things/car/shadow/name/{SHADOW}/update/accepted": {"version"},
        f"$aws/things/car/shadow/name/{SHADOW}/update/documents": set(),
        "$aws/things/car/shadow/update/accepted": set(),
    }
    assert {lane for lane, _ in SELECTED_BY} == set(LANES)
    for topic, rules in expected.items():
        assert {rule for rule, pattern in patterns.items() if matches(pattern, topic)} == rules, topic


@pytest.mark.parametrize("rule", RULES)
def test_a_message_cannot_overwrite_a_key_that_the_cloud_adds(rule):
    sql = RULES[rule].statement()
    selected = re.sub(r"\bencode\(\*, 'base64'\)", "encode()", sql[len("SELECT ") : sql.index(" FROM ")])
    names = [part.rsplit(" AS ", 1)[-1] for part in selected.split(", ")]
    assert len(names) == len(set(names))
    # Only the broker's own events are selected with *: robots do not write them, and the rule adds nothing.
    assert ("*" in selected) == (rule == "presence")
    assert names == ["*"] or "*" not in names
    assert (RECEIVED_MS in names) == (rule not in ("presence", "version"))
    assert (TOPIC in names) == (rule not in ("pong", "presence", "version"))
    assert (EXPIRES_S in names) == (rule == "record")
    assert (MESSAGE_BASE64 in names) == (rule in ("live", "echo", "upload", "ask"))
    for name, part in zip(names, selected.split(", ")):
        if name in (RECEIVED_MS, TOPIC, EXPIRES_S, ROBOT):
            assert re.match(r"(timestamp|topic|floor)\(", part), part


def test_the_record_rule_stores_all_keys_of_a_batch_and_a_pong_returns_all_keys_of_a_ping():
    batch = Batch("0badcafe", 0, [1], {"speed": [1.5]}, nonfinite=1, previous=())
    assert tuple(json.loads(encode_batch(batch))) == ENVELOPE
    assert tuple(json.loads(encode_ping(1, 1, "x"))) == PING_FIELDS
    assert RULES["record"].statement().startswith(f"SELECT {', '.join(ENVELOPE)}, topic() AS topic, ")
    assert RULES["pong"].statement().startswith(f"SELECT {', '.join(PING_FIELDS)}, timestamp() AS ")


def test_aws_allows_the_rules_names():
    for namespace in ("iort", "a" * 16):
        for rule in RULES:
            assert re.fullmatch(r"[a-zA-Z0-9_]{1,128}", RULES[rule].physical_name(namespace))


def test_a_statement_contains_the_deployments_parameters():
    stored = RULES["record"].statement("lab", retention_s=60)
    assert "+ 60 AS expires_s FROM 'dt/lab/+/+'" in stored
    assert RULES["battery"].statement(low_voltage_v=14).endswith("sample.voltage_input < 14")
    # A count of a regular expression has braces, too.
    assert not [rule for rule in RULES.values() if re.search(r"\{[a-z_]", rule.statement())]


def test_every_metrics_chart_is_drawn():
    rows = (*ROBOT_CHARTS, *metrics.SERVICE_CHARTS)
    drawn = {chart for row in rows for chart in row} | {metrics.QUEUES_CHART, metrics.LIVE_CHART}
    assert {metric.chart for metric in METRICS.values()} == drawn


# Functions read their environment as the stacks write it.


@pytest.mark.parametrize(
    "written",
    [
        LiveEnvironment("iort", "/iort/pubnub", {"vesc": ["speed"], "imu": []}, "queue"),
        LaterEnvironment("iort", "archive", "telemetry", "summary", "robots", "queue", True, "incident"),
        LaterEnvironment("iort", "archive", "telemetry", "summary", "robots", "queue", False, "incident"),
        AlertEnvironment("iort", "robots", "topic", 10.5),
        UploadEnvironment("iort", "files", "robots", "queue", 50 * 10**9),
    ],
)
def test_an_environment_is_read_as_it_was_written(written):
    variables = written.variables()
    assert all(isinstance(text, str) and name.isupper() for name, text in variables.items())
    assert type(written).read({**variables, "PATH": "/bin"}) == written


def test_a_missing_variable_is_named():
    with pytest.raises(KeyError, match="ALARM_TOPIC"):
        AlertEnvironment.read({"NAMESPACE": "iort", "ROBOTS_TABLE": "robots"})


# The table of the VESC's fields and faults.

# The messages of the drivers, in their order.
ROS1 = re.findall(
    r"\w+",
    """voltage_input temperature_pcb current_motor current_input speed duty_cycle charge_drawn charge_regen
    energy_drawn energy_regen displacement distance_traveled fault_code""",
)
ROS2 = re.findall(
    r"\w+",
    """temp_fet temp_motor current_motor current_input avg_id avg_iq duty_cycle speed voltage_input
    charge_drawn charge_regen energy_drawn energy_regen displacement distance_traveled fault_code
    pid_pos_now controller_id ntc_temp_mos1 ntc_temp_mos2 ntc_temp_mos3 avg_vd avg_vq""",
)


@pytest.mark.parametrize(("version", "expected"), [(1, ROS1), (2, ROS2)])
def test_the_fields_are_those_of_the_message(version, expected):
    assert {name for name, field in VESC_FIELDS.items() if version in field.ros} == set(expected)


def test_the_faults_are_the_firmwares_complete_list():
    assert list(FAULTS) == list(range(34))
    assert FAULT_CODES["OVER_TEMP_FET"] == FAULT_CODES["OVER_TEMP_MOTOR"] - 1 == 5
    assert FAULT_CODES["ABS_OVERSPEED"] == 33
    assert len(set(FAULTS.values())) == 34
    assert set(FAULT_CODES.values()) == FAULTS.keys()


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("temp_motor", -273.15, True),
        ("temp_motor", -50, True),
        ("temp_motor", -49.9, False),
        ("temp_motor", 0, False),
        ("temp_motor", None, False),
        ("temp_motor", False, False),
        ("temp_motor", "-273", False),
        ("temp_motor", float("nan"), False),
        ("temperature_pcb", -60.0, True),
        ("ntc_temp_mos3", -60.0, True),
        ("current_motor", -60.0, False),
        ("temperature_outside", -60.0, False),
    ],
)
def test_a_sensor_that_is_not_fitted_gives_no_temperature(field, value, expected):
    assert absent(field, value) is expected
