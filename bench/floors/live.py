"""The floor of Lambda 1: a live message to its channel of PubNub, by the barest code.

It takes the message out of the rule's event, puts sample and times into an update, and posts that over
one kept connection. It checks nothing, holds nothing against its age, leaves no field out, and has no
quarantine, metrics, limits or retries."""

from __future__ import annotations

import base64
import functools
import http.client
import json
import os
import time
from typing import Any

import boto3


def handler(event: dict[str, Any], _context: object) -> None:
    """Publish the event's message."""
    live = json.loads(base64.b64decode(event["message_base64"]))
    _, namespace, robot, stream = event["topic"].split("/")
    update = {
        "v": live["v"],
        "robot": robot,
        "stream": stream,
        "boot": live["boot"],
        "seq": live["seq"],
        "t": live["t"],
        "hops": {
            "sent_us": live["sent_us"],
            "received_ms": event["received_ms"],
            "lambda_us": time.time_ns() // 1000,
        },
        "sample": live["sample"],
    }
    connection, path = _connection()
    body = json.dumps(update, separators=(",", ":"))
    connection.request("POST", path.format(channel=f"{namespace}.{robot}"), body)
    answer = connection.getresponse()
    told = answer.read()
    if answer.status != http.client.OK:
        raise RuntimeError(f"PubNub must take the message, got {answer.status}: {told[:400]!r}")


@functools.cache
def _connection() -> tuple[http.client.HTTPConnection, str]:
    """The connection and the path, from the keys in Parameter Store, which a first invocation reads."""
    answer = boto3.client("ssm").get_parameter(Name=os.environ["PUBNUB_PARAMETER"], WithDecryption=True)
    keys = json.loads(answer["Parameter"]["Value"])
    kind = http.client.HTTPSConnection if keys.get("tls", True) else http.client.HTTPConnection
    origin = keys.get("origin") or "ps.pndsn.com"
    path = f"/publish/{keys['publish_key']}/{keys['subscribe_key']}/0/{{channel}}/0?store=0&uuid=iort-bench"
    return kind(origin, timeout=1), path
