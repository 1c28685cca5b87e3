"""Attributes of stored items as Python values, for any content that a robot may send."""

from __future__ import annotations

from decimal import Decimal

from boto3.dynamodb.types import TypeDeserializer


class _Exact(TypeDeserializer):  # type: ignore[misc]  # boto3 has no types
    """Numbers in full: boto3's own context rejects over 38 digits, and 1e125 may be written with 126."""

    def _deserialize_n(self, value: str) -> Decimal:
        return Decimal(value)


deserialize = _Exact().deserialize
