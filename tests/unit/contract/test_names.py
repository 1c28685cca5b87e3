"""Topics are parsed as they were built; every edge refuses a hostile name."""

from __future__ import annotations

import importlib
import pkgutil

import pytest
from hypothesis import given
from hypothesis import strategies as st

import iort_contract
from iort_contract import expression
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
from iort_contract.track import Track, parse_track

robots = st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True)
namespaces = st.from_regex(r"[a-z][a-z0-9]{0,15}", fullmatch=True)


HOSTILE = [
    "",
    "+",
    "#",
    "a/b",
    "$aws",
    "car\n",
    "\ncar",
    " car",
    "car.1",
    "a" * 65,
    "größe",
    "car٣",
    "\ud800",
    None,
    7,
    b"car",
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


# A track's CSV file: as the usual tools write it, and what is wrong with others.

SQUARE = Track((0.0, 4.0, 4.0, 0.0), (0.0, 0.0, 3.0, 3.0), (1.1,) * 4, (0.9,) * 4)


@pytest.mark.parametrize(
    "text",
    [
        "# x_m, y_m, w_tr_right_m, w_tr_left_m\n0.0, 0.0, 1.1, 0.9\n4,0,1.1,0.9\n4,3,1.1,0.9\n0,3,1.1,0.9\n",
        "x_m;y_m;w_right_m;w_left_m\r\n0;0;1.1;0.9\r\n4;0;1.1;0.9\r\n4;3;1.1;0.9\r\n0;3;1.1;0.9\r\n",
        "0,0,1.1,0.9\n4,0,1.1,0.9\n\n4,0,1.1,0.9\n4,3,1.1,0.9\n0,3,1.1,0.9\n0,0,1.1,0.9",
        SQUARE.csv(),
    ],
    ids=["F1TENTH and TU Munich", "names and semicolons", "doubled points and a closed line", "our own"],
)
def test_the_usual_files_are_read(text: str) -> None:
    assert parse_track(text) == SQUARE


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "4 to 20000 points, got 0"),
        ("0,0,1,1\n1,0,1,1\n0,0,1,1\n", "4 to 20000 points, got 2"),
        ("0,0,1,1\n1,0,1\n", "line 2 must be the four numbers x_m, y_m, w_right_m, w_left_m, got '1,0,1'"),
        ("s;x;y;psi;kappa;vx;ax\n0;1;2;3;4;5;6\n", "line 2 must be the four numbers"),
        ("0,0,1,1\nx,0,1,1\n", "line 2 must be the four numbers"),
        ("0,0,1,1\nnan,0,1,1\n", "line 2 must be the four numbers"),
        ("0,0,1,1\ninf,0,1,1\n", "line 2 must be within 100000 m"),
        ("0,0,1,-1\n", "line 1: widths must be over 0 m"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(text: str, said: str) -> None:
    with pytest.raises(ContractError, match=said):
        parse_track(text)


# Conditions are also read by the Python of a robot; what they mean is tested against numpy's columns.


def test_a_condition_is_read_without_numpy() -> None:
    node = expression.parse("0 < speed <= 2 and abs(current) > 1.5 and mode in ('a', 'b') or pose.x is None")
    columns = {
        "speed": [1, 3, 3],
        "current": [-2, -2, -2],
        "mode": ["b", "b", "b"],
        "pose.x": [0.5, 0.5, None],
    }
    assert expression.names(node) == set(columns)
    assert expression.holds(node, columns, 3) == [True, False, True]


# Every module of the contract can be imported, on the robot's oldest Python too (`make test-oldest`).

MODULES = [one.name for one in pkgutil.walk_packages(iort_contract.__path__, "iort_contract.")]


@pytest.mark.parametrize("name", MODULES)
def test_the_module_can_be_imported(name: str) -> None:
    assert importlib.import_module(name).__doc__
