"""Questions to the cloud, asked by the operator in a robot's name: without quota or deadline."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from iort_station.cloud import Cloud
from iort_station.errors import StationError


def ask(cloud: Cloud, robot: str, question: str, body: Mapping[str, Any]) -> dict[str, Any]:
    """The answer's body. Raises `StationError` if the function refuses or fails."""
    event = {"robot": robot, "question": question, "body": body}
    reply = cloud.client("lambda").invoke(
        FunctionName=cloud.output("processing", "AnswerFunction"), Payload=json.dumps(event).encode()
    )
    said = json.loads(reply["Payload"].read())
    if "FunctionError" in reply:
        raise StationError(f"the function answer failed: {said.get('errorMessage', said)}")
    if "refused" in said:
        raise StationError(f"{said['refused']}: {said['text']}")
    return dict(said["body"])
