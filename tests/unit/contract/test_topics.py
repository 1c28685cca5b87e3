"""Topics are parsed as they were built; every edge refuses a hostile name."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract.catalog.rules import RULES
from iort_contract.cloud import channel, fleet_name, pubnub_parameter
from iort_contract.limits import ContractError
from iort_contract.topics import (
    LANES,
    build_topic,
    check_namespace,
    check_robot,
    check_stream,
    parse_topic,
    record_topic,
    rule_name,
)

robots = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
namespaces = st.from_regex(r"[a-z][a-z0-9]{0,15}", fullmatch=True)


HOSTILE = [
    "",
    "+",
    "#",
    "car/+",
    "car#",
    "a/b",
    "/",
    "$aws",
    "car\n",
    "\ncar",
    "car\0",
    " car",
    "car car",
    "car.1",
    "a" * 65,
    "größe",
    "car٣",
    "\uff43ar",
    "${topic(3)}",
    "car'; DROP",
    "*",
    ",",
    "\ud800",
    None,
    7,
    b"car",
    ["car"],
]


@given(st.sampled_from(LANES), robots, robots, namespaces)
def test_topic_round_trip(lane, robot, name, namespace):
    topic = build_topic(lane, robot, name, namespace)
    parsed = parse_topic(topic)
    assert parsed == (lane, namespace, robot, name)
    assert str(parsed) == topic
    assert len(topic.encode()) <= 256, "the topic limit of AWS IoT Core"


@given(robots, robots, namespaces)
def test_record_topic_is_basic_ingest_to_the_record_rule(robot, stream, namespace):
    dollar_aws, rules, rule, rest = record_topic(robot, stream, namespace).split("/", 3)
    assert (dollar_aws, rules, rule) == ("$aws", "rules", rule_name("record", namespace))
    assert parse_topic(rest) == ("dt", namespace, robot, stream)


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_every_function_refuses_hostile_names(name):
    for refused in (
        lambda: check_robot(name),
        lambda: check_stream(name),
        lambda: check_namespace(name),
        lambda: build_topic("dt", name, "vesc"),
        lambda: build_topic("dt", "car", name),
        lambda: build_topic("dt", "car", "vesc", name),
        lambda: build_topic(name, "car", "vesc"),
        lambda: record_topic(name, "vesc"),
        lambda: parse_topic(f"dt/iort/{name}/vesc") if isinstance(name, str) else parse_topic(name),
        lambda: channel(name),
        lambda: rule_name(name),
        lambda: rule_name("record", name),
        lambda: RULES["record"].statement(name),
        lambda: RULES["pong"].action.topic(name),
        lambda: pubnub_parameter(name),
        lambda: fleet_name(name),
    ):
        with pytest.raises(ContractError):
            refused()


@given(st.text(st.characters(), max_size=70))
def test_any_name_is_safe_or_refused(name):
    try:
        check_robot(name)
    except ContractError:
        return
    assert set(name.encode("ascii")) <= set(
        b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-"
    )
    assert 1 <= len(name) <= 64


@given(st.text(st.characters(), max_size=40) | robots.map("dt/iort/{}/vesc".format))
def test_any_topic_is_rebuilt_the_same_or_refused(topic):
    try:
        parsed = parse_topic(topic)
    except ContractError:
        return
    assert build_topic(parsed.lane, parsed.robot, parsed.name, parsed.namespace) == topic


@pytest.mark.parametrize("namespace", ["Iort", "1iort", "io-rt", "io_rt", "a" * 17])
def test_a_namespace_has_stricter_rules_than_a_name(namespace):
    with pytest.raises(ContractError, match="namespace"):
        check_namespace(namespace)
