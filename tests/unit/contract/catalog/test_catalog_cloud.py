"""Rules and metrics: the cloud's rules select the topics on which the robots publish."""

from __future__ import annotations

import json
import re

import pytest

from iort_contract.catalog import metrics
from iort_contract.catalog.metrics import METRICS, ROBOT_CHARTS
from iort_contract.catalog.rules import RULES
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.live import encode_ping
from iort_contract.tables import ENVELOPE, EXPIRES_S, MESSAGE_BASE64, PING_FIELDS, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import FILE, LANES, PING_PATHS, build_topic


def matches(pattern, topic):
    """MQTT's wildcards, without ``#``, which no rule of ours uses."""
    levels, wanted = topic.split("/"), pattern.split("/")
    return len(levels) == len(wanted) and all(map(lambda w, level: w in ("+", level), wanted, levels))


RULE_TOPICS = {
    "record": ("dt", "vesc"),
    "live": ("live", "vesc"),
    "pong": ("ping", "rule"),
    "echo": ("ping", "lambda"),
    "upload": ("ping", "file"),
}


@pytest.mark.parametrize("rule", RULE_TOPICS)
@pytest.mark.parametrize("namespace", ["iort", "stage2"])
def test_a_rule_selects_exactly_its_own_topics(rule, namespace):
    sql = RULES[rule].statement(namespace)
    [pattern] = re.findall(r"FROM '([^']*)'", sql)
    assert pattern.split("/")[:2] == [RULE_TOPICS[rule][0], namespace]
    every = [(lane, name) for lane in LANES for name in ("vesc", FILE, *PING_PATHS)]
    heard = {pair for pair in every if matches(pattern, build_topic(pair[0], "car", pair[1], namespace))}
    lane, name = RULE_TOPICS[rule]
    expected = {(lane, name)} if lane == "ping" else {pair for pair in every if pair[0] == lane}
    assert heard == expected
    assert not matches(pattern, build_topic(lane, "car", name, "other"))


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
        if name in (
            RECEIVED_MS,
            TOPIC,
            EXPIRES_S,
            ROBOT,
        ):
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
    assert not [rule for rule in RULES.values() if "{" in rule.statement()]


def test_every_metrics_chart_is_drawn():
    rows = (*ROBOT_CHARTS, *metrics.SERVICE_CHARTS)
    drawn = {chart for row in rows for chart in row} | {metrics.QUEUES_CHART, metrics.LIVE_CHART}
    assert {metric.chart for metric in METRICS.values()} == drawn
