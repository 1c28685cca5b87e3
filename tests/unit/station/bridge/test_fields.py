"""Samples as JSON with a schema, as a message path of Foxglove needs them."""

from __future__ import annotations

import json
import math

import pytest

from iort_station.bridge.fields import encoded, nested, topic_of


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"speed": 1.5, "on": True, "text": "a"}, {"speed": 1.5, "on": True, "text": "a"}),
        ({"a.b.c": 1, "a.b.d": 2, "e": 3}, {"a": {"b": {"c": 1, "d": 2}}, "e": 3}),
        ({"ranges.0": 1, "ranges.1": 2}, {"ranges": [1, 2]}),
        ({"w.0.x": 1, "w.1.x": 2}, {"w": [{"x": 1}, {"x": 2}]}),
        # Chosen elements keep their numbers.
        ({"ranges.5": 1, "ranges.90": 2}, {"ranges": {"5": 1, "90": 2}}),
        # A field that is also the beginning of others.
        ({"a": 1, "a.b": 2}, {"a": 1, "a.b": 2}),
        ({"a.b": 2, "a": 1}, {"a": 1, "a.b": 2}),
    ],
)
def test_dots_become_objects_and_numbers_lists(
    fields: dict[str, object], expected: dict[str, object]
) -> None:
    assert nested(fields) == expected


def test_a_number_that_json_cannot_have_is_null() -> None:
    assert json.loads(encoded({"a": math.nan, "b": -math.inf, "c": 1, "d": None})) == {
        "a": None,
        "b": None,
        "c": 1,
        "d": None,
    }


def test_a_schema_has_units_and_meanings() -> None:
    topic = topic_of(
        "vesc",
        {"voltage_input": "number", "odd.0": "number", "odd.1": "number"},
        {"voltage_input": "V", "odd.0": "m", "odd.1": "m"}.__getitem__,
        "/car7",
    )
    schema = json.loads(topic.definition)
    assert (topic.name, topic.encoding, topic.schema_encoding) == ("/car7/iort/vesc", "json", "jsonschema")
    assert schema["properties"]["voltage_input"]["description"] == "V: battery voltage at the controller"
    assert schema["properties"]["odd"] == {"type": "array", "items": {"type": "number", "description": "m"}}
