"""Rules and metrics: what the cloud is told to listen to is what the robots say."""

from __future__ import annotations

import json
import re

import pytest

from iort_contract.cloud import METRICS, rule_sql
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.event import MESSAGE_BASE64
from iort_contract.messages.live import PING_FIELDS, encode_ping
from iort_contract.tables import ENVELOPE, EXPIRES_S, RECEIVED_MS, ROBOT, TOPIC
from iort_contract.topics import FILE, LANES, PING_PATHS, RULES, build_topic, rule_name


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
def test_rule_listens_to_its_own_topics_of_the_contract(rule, namespace):
    sql = rule_sql(rule, namespace)
    [pattern] = re.findall(r"FROM '([^']*)'", sql)
    assert pattern.split("/")[:2] == [RULE_TOPICS[rule][0], namespace]
    every = [(lane, name) for lane in LANES for name in ("vesc", FILE, *PING_PATHS)]
    heard = {pair for pair in every if matches(pattern, build_topic(pair[0], "car", pair[1], namespace))}
    lane, name = RULE_TOPICS[rule]
    expected = {(lane, name)} if lane == "ping" else {pair for pair in every if pair[0] == lane}
    assert heard == expected
    assert not matches(pattern, build_topic(lane, "car", name, "other"))


@pytest.mark.parametrize("rule", RULES)
def test_no_key_of_a_message_can_stand_where_the_cloud_s_own_stands(rule):
    sql = rule_sql(rule)
    selected = re.sub(r"\bencode\(\*, 'base64'\)", "encode()", sql[len("SELECT ") : sql.index(" FROM ")])
    names = [part.rsplit(" AS ", 1)[-1] for part in selected.split(", ")]
    assert len(names) == len(set(names))
    # The broker's own events alone are taken whole: no robot says anything in them, and nothing is added.
    assert ("*" in selected) == (rule == "presence")
    assert names == ["*"] or "*" not in names
    assert (RECEIVED_MS in names) == (rule not in ("presence", "version"))
    assert (TOPIC in names) == (rule not in ("pong", "presence", "version"))
    assert (EXPIRES_S in names) == (rule == "record")
    assert (MESSAGE_BASE64 in names) == (rule in ("live", "echo", "upload"))
    for name, part in zip(names, selected.split(", ")):
        if name in (
            RECEIVED_MS,
            TOPIC,
            EXPIRES_S,
            ROBOT,
        ):
            assert re.match(r"(timestamp|topic|floor)\(", part), part


def test_the_record_rule_stores_what_a_batch_says_and_a_pong_what_a_ping_says():
    batch = Batch("0badcafe", 0, [1], {"speed": [1.5]}, nonfinite=1, previous=())
    assert tuple(json.loads(encode_batch(batch))) == ENVELOPE
    assert tuple(json.loads(encode_ping(1, 1, "x"))) == PING_FIELDS
    assert rule_sql("record").startswith(f"SELECT {', '.join(ENVELOPE)}, topic() AS topic, ")
    assert rule_sql("pong").startswith(f"SELECT {', '.join(PING_FIELDS)}, timestamp() AS ")


def test_rule_names_are_allowed_by_aws():
    for namespace in ("iort", "a" * 16):
        for rule in RULES:
            assert re.fullmatch(r"[a-zA-Z0-9_]{1,128}", rule_name(rule, namespace))


def test_metric_names_are_unique():
    every = [name for group in METRICS.values() for name in group]
    assert len(every) == len(set(every))
