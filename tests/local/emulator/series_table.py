"""An emulator table in this process, with our tables' key schema."""

from __future__ import annotations

from typing import Any

from ministack.services import dynamodb


def create(name: str, kind: str = "N", **more: Any) -> None:
    """Create a table of topic by time, where ``kind`` is the time's type; needs a ``request_scope``."""
    created = dynamodb._create_table(
        {
            "TableName": name,
            "KeySchema": [
                {"AttributeName": "topic", "KeyType": "HASH"},
                {"AttributeName": "t", "KeyType": "RANGE"},
            ],
            "AttributeDefinitions": [
                {"AttributeName": "topic", "AttributeType": "S"},
                {"AttributeName": "t", "AttributeType": kind},
            ],
            "BillingMode": "PAY_PER_REQUEST",
            **more,
        }
    )
    assert created[0] == 200, created
