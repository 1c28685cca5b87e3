"""A message's dataclass from its envelope and back: each entry is a field, checked by its annotation.
And a topic rule's event for a function, with the message's bytes and the cloud's own keys.
"""

from __future__ import annotations

import base64
import json
from dataclasses import MISSING, fields
from functools import lru_cache
from typing import Any, Callable, Mapping, NamedTuple, TypeVar, Union

from iort_contract.checks import check_version, integer, json_object, shown, text
from iort_contract.limits import MAX_MESSAGE_BYTES, SCHEMA_VERSION, ContractError
from iort_contract.tables import MESSAGE_BASE64, RECEIVED_MS, T_US, TOPIC

M = TypeVar("M")
# Fields whose entry has another name.
_ENTRIES = {"t_us": T_US}


class _Field(NamedTuple):
    name: str
    entry: str
    required: bool
    # None for a message within the message.
    read: Callable[[Mapping[str, Any], str], Any] | None


@lru_cache(maxsize=None)
def _fields(kind: type[Any]) -> tuple[_Field, ...]:
    """The fields of a message's dataclass or named tuple."""
    defaults = getattr(kind, "_field_defaults", None)
    if defaults is None:
        defaults = {
            field.name: field
            for field in fields(kind)
            if field.default is not MISSING or field.default_factory is not MISSING
        }
    # A named tuple has its annotations as references.
    annotations = {name: str(getattr(of, "__forward_arg__", of)) for name, of in kind.__annotations__.items()}
    return tuple(
        _Field(name, _ENTRIES.get(name, name), name not in defaults, _READERS.get(of.split(" | ")[0]))
        for name, of in annotations.items()
    )


def read(kind: type[M], envelope: Any, **nested: Callable[[Any], Any]) -> M:
    """The message in an envelope; raises `ContractError`. A missing entry has its field's default.

    ``nested`` has the decoders of the fields that are messages themselves, or have another form.
    """
    if not isinstance(envelope, Mapping):
        raise ContractError(f"{kind.__name__} must be an object, got {shown(envelope)}")
    values = {}
    for field in _fields(kind):  # type: ignore[arg-type]  # a type is hashable
        if field.required or field.entry in envelope:
            if field.name in nested:
                values[field.name] = nested[field.name](envelope.get(field.entry))
            else:
                assert field.read is not None, f"{kind.__name__}.{field.name} needs a decoder"
                values[field.name] = field.read(envelope, field.entry)
    return kind(**values)


def entries(message: Any) -> dict[str, Any]:
    """The entries of a message, without those at their field's default."""
    return {
        _ENTRIES.get(field.name, field.name): getattr(message, field.name)
        for field in fields(message)
        if field.default is MISSING or getattr(message, field.name) != field.default
    }


Wire = Union[bytes, str, Mapping[str, Any]]


def codec(
    kind: type[M], what: str, check: Callable[[M], object], **nested: Callable[[Any], Any]
) -> tuple[Callable[[M], bytes], Callable[[Wire], M]]:
    """Two functions: one encodes a message as JSON, the other decodes it. Both raise `ContractError` for a
    message that ``check`` refuses, and the second for everything that the first cannot have written."""

    def encode(message: M) -> bytes:
        try:
            payload = to_json({"v": SCHEMA_VERSION, **entries(message)})
        except ContractError as error:
            raise ContractError(f"{what}: {error}") from error
        if len(payload) > MAX_MESSAGE_BYTES:
            raise ContractError(f"{what} must be at most {MAX_MESSAGE_BYTES} bytes, got {len(payload)}")
        decode(payload)
        return payload

    def decode(payload: Wire) -> M:
        envelope = payload if isinstance(payload, Mapping) else json_object(payload, what)
        check_version(envelope)
        message = read(kind, envelope, **nested)
        check(message)
        return message

    return encode, decode


def to_json(value: Mapping[str, Any]) -> bytes:
    """An object as JSON, with dataclasses as their entries; raises `ContractError` for what JSON does not
    have."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, default=entries).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise ContractError(f"the message is not JSON: {error}") from error


def number(envelope: Mapping[str, Any], key: str) -> float:
    """An entry that is a number; raises `ContractError`."""
    value = envelope.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ContractError(f"{key} must be a number, got {shown(value)}")
    try:
        return float(value)
    except OverflowError as error:  # an integer may be larger than every float
        raise ContractError(f"{key} must be a number, got {shown(value)}") from error


def _flag(envelope: Mapping[str, Any], key: str) -> bool:
    value = envelope.get(key)
    if not isinstance(value, bool):
        raise ContractError(f"{key} must be true or false, got {shown(value)}")
    return value


def _names(envelope: Mapping[str, Any], key: str) -> tuple[str, ...]:
    value = envelope.get(key)
    if not isinstance(value, (list, tuple)) or not all(isinstance(name, str) for name in value):
        raise ContractError(f"{key} must be a list of names, got {shown(value)}")
    return tuple(value)


def _mapping(envelope: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = envelope.get(key)
    if not isinstance(value, Mapping):
        raise ContractError(f"{key} must be an object, got {shown(value)}")
    return value


def _bytes(envelope: Mapping[str, Any], key: str) -> bytes:
    try:
        return base64.b64decode(text(envelope, key), validate=True)
    except ValueError as error:
        raise ContractError(f"{key} must be base64: {error}") from error


_READERS: Mapping[str, Callable[[Mapping[str, Any], str], Any]] = {
    "int": integer,
    "float": number,
    "str": text,
    "bool": _flag,
    "bytes": _bytes,
    "tuple[str, ...]": _names,
    "Mapping[str, Any]": _mapping,
    "Mapping[str, int]": _mapping,
    "Mapping[str, Value]": _mapping,
    "Any": lambda envelope, key: envelope.get(key),
}


def each(decode: Callable[[Any], Any]) -> Callable[[Any], dict[str, Any]]:
    """A decoder of an object whose values ``decode`` takes."""

    def decode_each(content: Any) -> dict[str, Any]:
        if not isinstance(content, Mapping):
            raise ContractError(f"must be an object, got {shown(content)}")
        return {str(name): decode(value) for name, value in content.items()}

    return decode_each


def rule_event(message: bytes, topic: str, received_ms: int) -> dict[str, Any]:
    """The event that the rules live, echo and upload make of a message."""
    return {MESSAGE_BASE64: base64.b64encode(message).decode(), TOPIC: topic, RECEIVED_MS: received_ms}


def event_message(event: Mapping[str, Any]) -> bytes:
    """The message of a `rule_event` as it was sent; raises `ContractError` for another kind of event."""
    encoded = event.get(MESSAGE_BASE64)
    if not isinstance(encoded, str):
        raise ContractError(f"{MESSAGE_BASE64} must be text, got {shown(encoded)}")
    try:
        return base64.b64decode(encoded, validate=True)
    except ValueError as error:
        raise ContractError(f"{MESSAGE_BASE64} must be base64") from error
