"""Names and topics: what is built is parsed, and a hostile name is refused at every edge."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import iort_contract
from iort_contract import ContractError
from iort_contract.catalog.rules import RULES

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


@given(st.sampled_from(iort_contract.LANES), robots, robots, namespaces)
def test_topic_round_trip(lane, robot, name, namespace):
    topic = iort_contract.build_topic(lane, robot, name, namespace)
    parsed = iort_contract.parse_topic(topic)
    assert parsed == (lane, namespace, robot, name)
    assert str(parsed) == topic
    assert len(topic.encode()) <= 256, "the topic limit of AWS IoT Core"


@given(robots, robots, namespaces)
def test_record_topic_is_basic_ingest_to_the_record_rule(robot, stream, namespace):
    dollar_aws, rules, rule, rest = iort_contract.record_topic(robot, stream, namespace).split("/", 3)
    assert (dollar_aws, rules, rule) == ("$aws", "rules", iort_contract.rule_name("record", namespace))
    assert iort_contract.parse_topic(rest) == ("dt", namespace, robot, stream)


@pytest.mark.parametrize("name", HOSTILE, ids=ascii)
def test_hostile_names_are_refused_everywhere(name):
    for refused in (
        lambda: iort_contract.check_robot(name),
        lambda: iort_contract.check_stream(name),
        lambda: iort_contract.check_namespace(name),
        lambda: iort_contract.build_topic("dt", name, "vesc"),
        lambda: iort_contract.build_topic("dt", "car", name),
        lambda: iort_contract.build_topic("dt", "car", "vesc", name),
        lambda: iort_contract.build_topic(name, "car", "vesc"),
        lambda: iort_contract.record_topic(name, "vesc"),
        lambda: (
            iort_contract.parse_topic(f"dt/iort/{name}/vesc")
            if isinstance(name, str)
            else iort_contract.parse_topic(name)
        ),
        lambda: iort_contract.channel(name),
        lambda: iort_contract.rule_name(name),
        lambda: iort_contract.rule_name("record", name),
        lambda: RULES["record"].statement(name),
        lambda: RULES["pong"].action.topic(name),
        lambda: iort_contract.pubnub_parameter(name),
        lambda: iort_contract.fleet_name(name),
    ):
        with pytest.raises(ContractError):
            refused()


@given(st.text(st.characters(), max_size=70))
def test_any_name_is_refused_or_safe(name):
    try:
        iort_contract.check_robot(name)
    except ContractError:
        return
    assert set(name.encode("ascii")) <= set(
        b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-"
    )
    assert 1 <= len(name) <= 64


@given(st.text(st.characters(), max_size=40) | robots.map("dt/iort/{}/vesc".format))
def test_any_topic_is_refused_or_built_alike(topic):
    try:
        parsed = iort_contract.parse_topic(topic)
    except ContractError:
        return
    assert iort_contract.build_topic(parsed.lane, parsed.robot, parsed.name, parsed.namespace) == topic


@pytest.mark.parametrize("namespace", ["Iort", "1iort", "io-rt", "io_rt", "a" * 17])
def test_namespace_is_stricter(namespace):
    with pytest.raises(ContractError, match="namespace"):
        iort_contract.check_namespace(namespace)
