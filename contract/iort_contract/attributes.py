"""Attributes of stored items as Python values, whatever a robot has put there."""

from __future__ import annotations

from decimal import Decimal
from typing import Any, Mapping

from boto3.dynamodb.types import TypeDeserializer


class _Exact(TypeDeserializer):  # type: ignore[misc]  # boto3 has no types
    """Numbers as they are written: boto3's own context raises for one of over 38 digits, and 1e125 may be
    written as 126."""

    def _deserialize_n(self, value: str) -> Decimal:
        return Decimal(value)


deserialize = _Exact().deserialize


def plain(item: Mapping[str, Any]) -> dict[str, Any]:
    """An item as Python values; numbers are Decimals, bytes are boto3's `Binary`."""
    return {name: deserialize(value) for name, value in item.items()}
