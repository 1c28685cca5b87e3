"""Samples as JSON, with a schema that has each field's unit: what a stream is without its messages' own type.

A field's dots become objects, and numbered ones lists: ``pose.position.x`` is ``{"pose": {"position": {"x":
...}}}``, as a message path of Foxglove needs it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

from iort_analysis.samples.blocks import Column, values
from iort_contract.catalog.streams import CATALOG
from iort_contract.limits import Value
from iort_station.bridge.channels import Topic

# Beside the topics that robots publish themselves.
PREFIX = "iort"
_ENCODER = json.JSONEncoder(ensure_ascii=False, separators=(",", ":"), allow_nan=False)


def topic_of(stream: str, kinds: Mapping[str, str], unit: Callable[[str], str], prefix: str = "") -> Topic:
    """The topic of a stream's fields. ``kinds`` are the fields with their types in JSON; ``prefix`` names the
    robot, if there are several."""
    schema = {"type": "object", "title": f"iort.{stream}", **_schema(stream, kinds, unit)}
    return Topic(
        f"{prefix}/{PREFIX}/{stream}", "json", f"iort.{stream}", "jsonschema", json.dumps(schema).encode()
    )


def kind_of(value: Value) -> str:
    """A value's type in JSON."""
    if isinstance(value, bool):
        return "boolean"
    return "string" if isinstance(value, str) else "number"


def encoded(sample: Mapping[str, Value]) -> bytes:
    """A sample as JSON; a number that JSON cannot have is null."""
    plain = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in sample.items()
    }
    return _ENCODER.encode(nested(plain)).encode()


def nested(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields as objects within objects. A field that is also the beginning of others keeps its dots."""
    if not any("." in name for name in fields):
        return dict(fields)
    tree = _Branch()
    for name, value in fields.items():
        *above, last = name.split(".")
        inner, path = tree, ""
        for part in above:
            path = f"{path}.{part}" if path else part
            if path in fields:
                inner, last = tree, name
                break
            inner = inner.setdefault(part, _Branch())
        inner[last] = value
    return {name: _lists(value) for name, value in tree.items()}


class _Branch(dict[str, Any]):
    """An object that dots have made."""


def _lists(value: Any) -> Any:
    if not isinstance(value, _Branch):
        return value
    inner = {name: _lists(one) for name, one in value.items()}
    if all(name == str(i) for i, name in enumerate(inner)):
        return list(inner.values())
    return inner


def _schema(stream: str, kinds: Mapping[str, str], unit: Callable[[str], str]) -> dict[str, Any]:
    meanings = {field.name: field.meaning for field in CATALOG[stream].fields} if stream in CATALOG else {}
    leaves = {name: _Leaf(kind, _words(unit(name), meanings.get(name, ""))) for name, kind in kinds.items()}
    return _described(nested(leaves))


class _Leaf:
    def __init__(self, kind: str, text: str) -> None:
        self.schema = {"type": kind, **({"description": text} if text else {})}


def _words(unit: str, meaning: str) -> str:
    return ": ".join(filter(None, (unit, meaning)))


def _described(tree: Any) -> dict[str, Any]:
    if isinstance(tree, _Leaf):
        return tree.schema
    if isinstance(tree, list):
        # Its elements are alike.
        return {"type": "array", "items": _described(tree[0])}
    return {"type": "object", "properties": {name: _described(one) for name, one in tree.items()}}


def kinds_of(columns: Mapping[str, Column]) -> dict[str, str]:
    """The types in JSON of the columns of a block."""
    return {name: _kind_of_column(column) for name, column in columns.items()}


def _kind_of_column(column: Column) -> str:
    if column.dtype.kind in "fb":
        return "number" if column.dtype.kind == "f" else "boolean"
    return kind_of(next((value for value in values(column) if value is not None), ""))
