"""The examples of AWS' documentation give their results in the emulator's IoT SQL."""

from __future__ import annotations

import base64
import json

import pytest

from tests.rule_sql import evaluate

RED = {"color": "red", "temperature": 50}
COLORS = {"color": {"red": 255, "green": 0, "blue": 0}, "temperature": 50}
THING = "things/myThings/thingOne"
BUILDING = "Buildings/Building5/Floor2/Room201/Lights"
NOW_MS = 1_481_825_251_155


@pytest.mark.parametrize(
    ("sql", "payload", "expected"),
    [
        # "SELECT clause"
        ("SELECT * FROM 'topic/subtopic'", RED, RED),
        ("SELECT color FROM 'topic/subtopic'", RED, {"color": "red"}),
        ("SELECT color AS my_color FROM 'topic/subtopic'", RED, {"my_color": "red"}),
        (
            "SELECT color as my_color, temperature as fahrenheit FROM 'topic/subtopic'",
            RED,
            {"my_color": "red", "fahrenheit": 50},
        ),
        ("SELECT *, 15 as speed FROM 'topic/subtopic'", RED, {**RED, "speed": 15}),
        ("SELECT color.red as red_value FROM 'topic/subtopic'", COLORS, {"red_value": 255}),
        ("SELECT (temperature - 32) * 5 / 9 AS celsius FROM 'topic/subtopic'", RED, {"celsius": 10}),
        # "AWS IoT SQL reference" and "WHERE clause"
        (
            "SELECT color AS my_color FROM 'topic/subtopic' WHERE temperature > 50 AND color <> 'red'",
            {"color": "red", "temperature": 40},
            None,
        ),
        (
            "SELECT color AS rgb FROM 'topic/subtopic' WHERE temperature > 50",
            {"color": "red", "temperature": 100},
            {"rgb": "red"},
        ),
        ("SELECT color AS rgb FROM 'topic/subtopic' WHERE temperature > 50", RED, None),
        # "Data types": the key bar of {"foo": null} is Undefined, which JSON leaves out; null stays.
        ("SELECT foo, bar FROM 'topic/subtopic'", {"foo": None}, {"foo": None}),
        ("SELECT foo FROM 'topic/subtopic' WHERE bar > 0", {"foo": 1}, None),
        ("SELECT foo FROM 'topic/subtopic' WHERE bar <> ''", {"foo": 1}, None),
        # "Functions": floor
        ("SELECT floor(1.2) AS f FROM 'topic/subtopic'", {}, {"f": 1}),
        ("SELECT floor(-1.2) AS f FROM 'topic/subtopic'", {}, {"f": -2}),
        ("SELECT floor(a) AS f FROM 'topic/subtopic'", {"a": "-1.2"}, {"f": -2}),
        ("SELECT floor(a) AS f FROM 'topic/subtopic'", {"a": True}, {}),
        ("SELECT floor(a) AS f FROM 'topic/subtopic'", {"a": None}, {}),
        # timestamp: milliseconds since the epoch
        ("SELECT timestamp() AS ts FROM 'topic/subtopic'", {}, {"ts": NOW_MS}),
        # "Operators"
        ("SELECT floor(timestamp() / 1000) + 60 AS s FROM 'a'", {}, {"s": 1_481_825_251 + 60}),
        ("SELECT a / b AS q, a % b AS r FROM 'a'", {"a": 7, "b": 2}, {"q": 3, "r": 1}),
        ("SELECT a FROM 'a' WHERE a > 1 AND a < 3", {"a": 2}, {"a": 2}),
        ("SELECT a FROM 'a' WHERE a > 1 AND a < 3", {"a": 4}, None),
        # Both operands of > are converted to Decimal; another value, null too, leaves it Undefined.
        ("SELECT a FROM 'a' WHERE a > 1", {"a": "1.5"}, {"a": "1.5"}),
        ("SELECT a FROM 'a' WHERE a > 1", {"a": "x"}, None),
        ("SELECT a FROM 'a' WHERE a > 1", {"a": None}, None),
        ("SELECT a FROM 'a' WHERE a > 0", {"a": True}, None),
        # <> is true for mismatched types, and neither true nor false for Undefined.
        ("SELECT a FROM 'a' WHERE a <> ''", {"a": 7}, {"a": 7}),
        ("SELECT a FROM 'a' WHERE a <> ''", {"a": ""}, None),
    ],
)
def test_a_documented_statement_gives_its_result(sql, payload, expected):
    assert evaluate(sql, "topic/subtopic", json.dumps(payload).encode(), NOW_MS) == expected


@pytest.mark.parametrize(
    ("topic", "call", "expected"),
    [
        (THING, "topic()", THING),
        (THING, "topic(1)", "things"),
        # Basic Ingest's prefix is not available to the function.
        (BUILDING, "topic()", BUILDING),
        (BUILDING, "topic(3)", "Floor2"),
    ],
)
def test_a_documented_topic_call_gives_its_result(topic, call, expected):
    assert evaluate(f"SELECT {call} AS t FROM '#'", topic, b"{}", NOW_MS) == {"t": expected}


@pytest.mark.parametrize("payload", [b'{"a": 1.50}', b"no JSON", b"\xff\x00", b"", b"[1, 2]"])
def test_a_binary_payload_is_encoded_byte_by_byte(payload):
    """ "Working with binary payloads": also beside functions, for any payload."""
    sql = "SELECT encode(*, 'base64') AS data, timestamp() AS ts FROM 'topic/subtopic'"
    encoded = base64.b64encode(payload).decode()
    assert evaluate(sql, "topic/subtopic", payload, NOW_MS) == {"data": encoded, "ts": NOW_MS}
