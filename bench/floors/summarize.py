"""The floor of Lambda 2: batches of a stream's event to the same kind of items, by the barest code.

It decodes every value of every batch and writes the least, the mean, the greatest and the last one of each
field to the summary table: an item a batch, 25 in a signed request, over one TLS connection.

It checks nothing, and reads nothing back: it knows neither late, doubled or missing batches nor those that
share a second. It derives no speed or power, counts no gaps and no absent sensors, keeps no robot to its
share, and has no quarantine, metrics or retries."""

from __future__ import annotations

import base64
import functools
import hashlib
import hmac
import http.client
import json
import os
import ssl
import time
import zlib
from itertools import accumulate
from typing import Any
from urllib.parse import urlsplit

WRITE_ITEMS = 25
_TARGET = "DynamoDB_20120810.BatchWriteItem"
_SIGNED = "content-type;host;x-amz-date;x-amz-security-token;x-amz-target"


def handler(event: dict[str, Any], _context: object) -> None:
    """Summarise and write the event's batches."""
    items = [item(record["dynamodb"]["NewImage"]) for record in event["Records"]]
    for at in range(0, len(items), WRITE_ITEMS):
        _write(items[at : at + WRITE_ITEMS])


def item(image: dict[str, dict[str, str]]) -> dict[str, Any]:
    """The second of a batch, as DynamoDB's JSON."""
    inflater = zlib.decompressobj(zdict=os.environ["DICTIONARY"].encode())
    body = json.loads(inflater.decompress(base64.b64decode(image["samples"]["S"])))
    second: dict[str, Any] = {
        "topic": {"S": os.environ["TOPIC"]},
        "second": {"N": str(int(image["batch"]["S"][:16]) // 1_000_000)},
        "n": image["n"],
        "expires_s": image["expires_s"],
    }
    for name, (decimals, *steps) in body["fields"].items():
        scale = 10**decimals
        values = [whole / scale for whole in accumulate(steps)] if decimals else list(accumulate(steps))
        low, high = min(values), max(values)
        mean = float(f"{sum(values) / len(values):.9g}")
        found = [low] if low == high else [low, mean, high, values[-1]]
        second[name] = {"L": [{"N": repr(one)} for one in found]}
    return second


def _write(items: list[dict[str, Any]]) -> None:
    requests = [{"PutRequest": {"Item": one}} for one in items]
    body = json.dumps({"RequestItems": {os.environ["TABLE"]: requests}}, separators=(",", ":")).encode()
    connection, host = _connection()
    connection.request("POST", "/", body, _signed(host, body))
    answer = connection.getresponse()
    told = answer.read()
    if answer.status != http.client.OK or json.loads(told).get("UnprocessedItems"):
        raise RuntimeError(f"the table must take all items, got {answer.status}: {told[:400]!r}")


@functools.cache
def _connection() -> tuple[http.client.HTTPSConnection, str]:
    url = os.environ.get("AWS_ENDPOINT_URL") or f"https://dynamodb.{os.environ['AWS_REGION']}.amazonaws.com"
    host = urlsplit(url).netloc
    context = ssl.create_default_context(cafile=os.environ.get("AWS_CA_BUNDLE"))
    return http.client.HTTPSConnection(host, context=context, timeout=10), host


def _signed(host: str, body: bytes) -> dict[str, str]:
    """The headers of a request, with AWS' Signature Version 4."""
    at = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    headers = {
        "content-type": "application/x-amz-json-1.0",
        "host": host,
        "x-amz-date": at,
        "x-amz-security-token": os.environ.get("AWS_SESSION_TOKEN", ""),
        "x-amz-target": _TARGET,
    }
    shown = "".join(f"{name}:{value}\n" for name, value in headers.items())
    asked = f"POST\n/\n\n{shown}\n{_SIGNED}\n{hashlib.sha256(body).hexdigest()}"
    scope = f"{at[:8]}/{os.environ['AWS_REGION']}/dynamodb/aws4_request"
    text = f"AWS4-HMAC-SHA256\n{at}\n{scope}\n{hashlib.sha256(asked.encode()).hexdigest()}"
    signature = hmac.new(_key(scope), text.encode(), hashlib.sha256).hexdigest()
    credential = f"{os.environ['AWS_ACCESS_KEY_ID']}/{scope}"
    headers["authorization"] = (
        f"AWS4-HMAC-SHA256 Credential={credential}, SignedHeaders={_SIGNED}, Signature={signature}"
    )
    return headers


@functools.cache
def _key(scope: str) -> bytes:
    key = f"AWS4{os.environ['AWS_SECRET_ACCESS_KEY']}".encode()
    for part in scope.split("/"):
        key = hmac.new(key, part.encode(), hashlib.sha256).digest()
    return key
