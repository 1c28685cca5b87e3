"""Attributes of stored items as Python values, whatever a robot has put there."""

from __future__ import annotations

from decimal import Decimal
from typing import Any, Callable, Mapping


def plain(item: Mapping[str, Any]) -> dict[str, Any]:
    """An item as Python values: numbers are Decimals of any length, as boto3's deserializer refuses them."""
    return {name: deserialize(value) for name, value in item.items()}


def deserialize(attribute: Mapping[str, Any]) -> Any:
    """The value of an attribute such as ``{"N": "1.5"}``."""
    ((kind, content),) = attribute.items()
    return _VALUES[kind](content)


def _same(content: Any) -> Any:
    return content


_VALUES: dict[str, Callable[[Any], Any]] = {
    "S": _same,
    "N": Decimal,
    "B": _same,
    "BOOL": _same,
    "NULL": lambda _: None,
    "M": plain,
    "L": lambda content: [deserialize(each) for each in content],
    "SS": set,
    "NS": lambda content: {Decimal(each) for each in content},
    "BS": set,
}
