"""The constants and types of the contract as TypeScript for the page; scripts/docs_parts.py writes them."""

from __future__ import annotations

import json
import re
import types
from collections.abc import Iterator
from typing import Any, ForwardRef, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

from iort_contract import checks, limits, topics
from iort_contract import page as served
from iort_contract.catalog import analysis as findings
from iort_contract.catalog import vesc
from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.entries import Derived, Field
from iort_contract.catalog.metrics import METRICS
from iort_contract.catalog.streams import (
    CATALOG,
    DRIVE_STREAM,
    INCIDENT_STREAM,
    LOG_STREAM,
    POSE_STREAM,
    ROS_UNITS,
)
from iort_contract.catalog.vesc import FAULTS, TEMPERATURES, VESC_STREAM
from iort_contract.messages import analysis, commands, insights, live, page, video
from iort_contract.messages.files import ATTACHMENT_FIELDS

_PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2}
_ATOM = 3
# Their fields have names that other streams use for something else.
_NAMED = (POSE_STREAM, LOG_STREAM, DRIVE_STREAM, INCIDENT_STREAM)


class Symbol:
    """Stands for an argument of a formula; the operators on it give the formula's text."""

    def __init__(self, text: str, precedence: int = _ATOM) -> None:
        self.text = text
        self.precedence = precedence


def _operator(symbol: str, *, swapped: bool = False) -> Any:
    precedence = _PRECEDENCE[symbol]

    def operate(one: Symbol, other: Symbol | float) -> Symbol:
        sides = one, other if isinstance(other, Symbol) else Symbol(f"{other}")
        left, right = reversed(sides) if swapped else sides
        texts = (
            left.text if left.precedence >= precedence else f"({left.text})",
            right.text if right.precedence > precedence else f"({right.text})",
        )
        return Symbol(f" {symbol} ".join(texts), precedence)

    return operate


for _name, _text in {"add": "+", "sub": "-", "mul": "*", "truediv": "/"}.items():
    setattr(Symbol, f"__{_name}__", _operator(_text))
    setattr(Symbol, f"__r{_name}__", _operator(_text, swapped=True))


def formula(entry: Derived) -> str:
    """A derived field's formula as text, which Python and TypeScript read alike."""
    return str(entry.formula(*map(Symbol, entry.arguments)).text)


def page_contract() -> None:
    """The constants and types of the contract that the page's code uses."""
    print("\n".join([*_constants(), *_types()]).rstrip())


def _constants() -> Iterator[str]:
    for module, names in {
        limits: (
            "SCHEMA_VERSION",
            "MAX_FIELDS",
            "MAX_NEXT_MS",
            "STALE_S",
            "GONE_S",
            "LIVE_MAX_RATE_HZ",
        ),
        topics: ("NAME", "LIVE", "VIEW", "CMD"),
        checks: ("BOOT", "FIELD_NAME"),
        vesc: ("TACHOMETER_COUNTS",),
        findings: ("ANALYSIS_FAILED",),
        commands: (
            "MAX_LEASE_MS",
            "DRIVE_RATE_HZ",
            "DRIVE_LEASE_MS",
            "DRIVE_MAX_RTT_MS",
            "DRIVE_MAX_AGE_MS",
            "DRIVE_MARGIN_MS",
            "DRIVE_ANSWER_MS",
            "DRIVE_ENDS",
            "DRIVE_CORRECTIONS",
            "DRIVE_CLOCK_KEPT_MS",
            "LOST",
            "UNTIMELY",
        ),
        analysis: ("MAX_NOTE_CHARACTERS",),
        live: ("LEASE", "VIEW_LEASE_MS", "VIEW_RENEW_S"),
        video: (
            "PICTURE_MAX_AGE_MS",
            "MAX_SDP_BYTES",
            "CHANNEL",
            "ECHO_EVERY_MS",
            "ECHO_KEPT_MS",
            "VIDEO",
            "PICTURE",
            "TO",
        ),
        served: ("KEY_HEADER", "INVITATION"),
    }.items():
        for name in names:
            value = getattr(module, name)
            literal = f"/^(?:{value.pattern})$/" if isinstance(value, re.Pattern) else json.dumps(value)
            yield f"export const {name} = {literal};"
    yield f"export const LOG_STREAM = {json.dumps(LOG_STREAM)};"
    yield f"export const DRIVE_STREAM = {json.dumps(DRIVE_STREAM)};"
    yield f"export const INCIDENT_STREAM = {json.dumps(INCIDENT_STREAM)};"
    yield f"export const REFUSALS = {json.dumps(commands.REFUSALS, indent=2)} as const;"
    yield f"export const TEMPERATURES = {json.dumps(TEMPERATURES)} as const;"
    yield f"export const ATTACHMENT_PARTS = {json.dumps(list(ATTACHMENT_FIELDS))} as const;"
    yield f"export const ABSENT_FROM: Readonly<Record<string, number>> = {json.dumps(vesc.ABSENT_FROM)};"
    # The alarms that the page can see in a car's live values.
    cars = {name: metric.alarm for name, metric in METRICS.items() if metric.of_a_robot and metric.alarm}
    told = {name: {"meaning": alarm.meaning, "advice": alarm.advice} for name, alarm in cars.items()}
    yield f"export const CAR_ALARMS = {json.dumps(told, indent=2)} as const;"
    for entry in DERIVED.values():
        arguments = ", ".join(f"{name}: number" for name in entry.arguments)
        yield f"/** {entry.meaning}, {entry.unit} */"
        yield f"export const {entry.name} = ({arguments}): number => {formula(entry)};"
    table = {
        "version": limits.SCHEMA_VERSION,
        "stream": VESC_STREAM,
        "fields": {field.name: _described(field) for field in _fields()},
        "streams": {
            stream.name: {field.name: _described(field) for field in stream.fields}
            for stream in map(CATALOG.__getitem__, _NAMED)
        },
        "ros_units": ROS_UNITS,
        "faults": {str(code): name for code, name in FAULTS.items()},
    }
    text = json.dumps(table, indent=2, ensure_ascii=False)
    # A field a line.
    text = re.sub(r'\{\s+"unit"[^{}]*\}', lambda field: " ".join(field[0].split()), text)
    yield f"export const FIELD_TABLE: FieldTable = {text};"
    yield _FIELD_TABLE


def _fields() -> Iterator[Field | Derived]:
    for name, stream in CATALOG.items():
        if name not in _NAMED:
            yield from stream.fields
    yield from DERIVED.values()


def _described(field: Field | Derived) -> dict[str, str]:
    more = {"ros2_unit": getattr(field, "ros2_unit", None), "label": field.label}
    return {"unit": field.unit, "meaning": field.meaning} | {
        name: text for name, text in more.items() if text
    }


_FIELD_TABLE = """
export interface FieldEntry {
  readonly unit: string;
  readonly ros2_unit?: string;
  readonly meaning: string;
  /** What the page calls it, unless its name says it. */
  readonly label?: string;
}

export interface FieldTable {
  /** The schema version; messages of another version are refused. */
  readonly version: number;
  /** The stream with the VESC's fields. */
  readonly stream: string;
  readonly fields: Readonly<Record<string, FieldEntry>>;
  /** Stream -> its fields, whose names mean something else elsewhere. */
  readonly streams: Readonly<Record<string, Readonly<Record<string, FieldEntry>>>>;
  /** Field -> unit of the fields x, y and z within it. */
  readonly ros_units: Readonly<Record<string, string>>;
  readonly faults: Readonly<Record<string, string>>;
}

export type Value = null | boolean | number | string;
"""


def _types() -> Iterator[str]:
    """An interface for each message to the page."""
    for name, message in {**vars(insights), **vars(page)}.items():
        if is_typeddict(message) and not name.startswith("_"):
            comment = " ".join((message.__doc__ or "").split())
            yield f"/** {comment} */\nexport interface {name} {{"
            for key, hint in get_type_hints(message).items():
                optional = "" if key in message.__required_keys__ else "?"
                yield f"  readonly {key}{optional}: {_type(hint)};"
            yield "}\n"


def _type(hint: Any) -> str:
    if hint == limits.Value:
        return "Value"
    if isinstance(hint, ForwardRef) or is_typeddict(hint):
        return str(hint.__name__)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " | ".join(map(json.dumps, arguments))
    if origin in {Union, types.UnionType}:
        return " | ".join(map(_type, arguments))
    if origin is list:
        inner = _type(arguments[0])
        return f"readonly {f'({inner})' if ' ' in inner else inner}[]"
    if origin is dict:
        return f"Readonly<Record<string, {_type(arguments[1])}>>"
    return {str: "string", int: "number", float: "number", bool: "boolean", type(None): "null"}[hint]
