"""Samples that the query function (functions/query.py) selects in the cloud."""

from __future__ import annotations

import base64
import json
import ssl
import urllib.request
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from iort_contract.codec.columns import PLAIN_CODEC
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.batches import PageProgress, RefusedItems
from iort_station.data.blocks import Block, column_of, join, ordered
from iort_station.data.selection import Selection
from iort_station.errors import StationError

_DOWNLOAD_S = 60


def samples(
    cloud: Cloud,
    selection: Selection,
    *,
    refused: RefusedItems,
    absent: Counter[str],
    scan: bool = False,
    progress: PageProgress | None = None,
) -> Iterator[Block]:
    """The selection's samples, from as many invocations as needed.

    Raises `StationError` if the function fails, and at the end for a field that no sample has.
    """
    request: dict[str, Any] = {
        "robot": selection.robot,
        "stream": selection.stream,
        "start_us": selection.start_us,
        "end_us": selection.end_us,
        "fields": None if selection.fields is None else list(selection.fields),
        "where": selection.where,
        "scan": scan,
    }
    function = cloud.output("processing", "QueryFunction")
    parts: list[Block] = []
    there: set[str] = set()
    while True:
        reply = _invoke(cloud, function, request)
        part = _unpacked(cloud, reply)
        parts.append(part)
        there |= set(reply["fields"])
        refused.count += reply["refused"]
        refused.reason = refused.reason or reply["reason"]
        absent.update(reply["absent"])
        if progress is not None and len(part.times_us):
            progress(reply["items"], int(part.times_us[-1]))
        if reply["token"] is None:
            break
        request["token"] = reply["token"]
    if there and not selection.named() <= there:
        raise inventory.unknown_fields(cloud, selection, there)
    # A batch may overlap the next one, which another invocation may have read.
    block = ordered(join(parts))
    if len(block.times_us):
        names = selection.fields or tuple(block.columns)
        yield Block(block.times_us, {name: block.columns[name] for name in names})


def _invoke(cloud: Cloud, function: str, request: Mapping[str, Any]) -> dict[str, Any]:
    answer = cloud.client("lambda").invoke(FunctionName=function, Payload=json.dumps(request).encode())
    text = answer["Payload"].read()
    reply: dict[str, Any] = json.loads(text)
    if "FunctionError" in answer:
        raise StationError(f"the query function failed: {reply.get('errorMessage', text[:500])}")
    if "error" in reply:
        raise StationError(f"the query function refused: {reply['error']}")
    if reply["codec"] != PLAIN_CODEC:
        raise StationError(
            f"the query function must answer in {PLAIN_CODEC}, got {reply['codec']}: "
            "deploy the current stacks"
        )
    return reply


def _unpacked(cloud: Cloud, reply: Mapping[str, Any]) -> Block:
    packed = base64.b64decode(reply["samples"]) if "samples" in reply else _download(cloud, reply["url"])
    body = json.loads(zlib.decompress(packed))
    times = np.cumsum(np.array(body["dt"], dtype=np.int64))
    return Block(times, {name: column_of(column) for name, column in body["fields"].items()})


def _download(cloud: Cloud, url: str) -> bytes:
    context = ssl.create_default_context(cafile=cloud.ca_bundle)
    try:
        with urllib.request.urlopen(  # noqa: S310 - signed by our own function
            url, timeout=_DOWNLOAD_S, context=context
        ) as response:
            return bytes(response.read())
    except OSError as error:
        raise StationError(f"the result cannot be downloaded: {error}") from error
