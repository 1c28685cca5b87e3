"""Rules and metrics: what the cloud is told to listen to is what the robots say."""

from __future__ import annotations

import re

import pytest

import contract


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
    sql = contract.rule_sql(rule, namespace)
    [pattern] = re.findall(r"FROM '([^']*)'", sql)
    assert pattern.split("/")[:2] == [RULE_TOPICS[rule][0], namespace]
    every = [
        (lane, name) for lane in contract.LANES for name in ("vesc", contract.FILE, *contract.PING_PATHS)
    ]
    heard = {
        pair for pair in every if matches(pattern, contract.build_topic(pair[0], "car", pair[1], namespace))
    }
    lane, name = RULE_TOPICS[rule]
    expected = {(lane, name)} if lane == "ping" else {pair for pair in every if pair[0] == lane}
    assert heard == expected
    assert not matches(pattern, contract.build_topic(lane, "car", name, "other"))


@pytest.mark.parametrize("rule", RULE_TOPICS)
def test_what_the_cloud_says_overrides_the_message(rule):
    sql = contract.rule_sql(rule)
    # Lambda 1 alone is given the message as it came.
    whole = f"encode(*, 'base64') AS {contract.MESSAGE_BASE64}" if rule == "live" else "*"
    assert sql.startswith(f"SELECT {whole}, ")
    selected = ["*", *sql[len(f"SELECT {whole}, ") : sql.index(" FROM ")].split(", ")]
    named = [part.rsplit(" AS ", 1)[1] for part in selected[1:]]
    assert contract.RECEIVED_MS in named
    assert (contract.TOPIC in named) == (rule != "pong")
    assert (contract.EXPIRES_S in named) == (rule == "record")
    functions = set(re.findall(r"([a-zA-Z_]+)\(", sql))
    assert functions <= {"topic", "timestamp", "floor", "encode"}


def test_rule_names_are_allowed_by_aws():
    for namespace in ("iort", "a" * 16):
        for rule in contract.RULES:
            assert re.fullmatch(r"[a-zA-Z0-9_]{1,128}", contract.rule_name(rule, namespace))


def test_metric_names_are_unique():
    every = [name for group in contract.METRICS.values() for name in group]
    assert len(every) == len(set(every))
