"""Samples that the query function (functions/query.py) selects in the cloud."""

from __future__ import annotations

import json
import ssl
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from iort_analysis.archive.stored import PageProgress
from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import Block, column_of, join, ordered
from iort_contract.limits import ContractError
from iort_contract.messages.requests.query import (
    FIRST_US,
    LAST_US,
    QueryAnswer,
    QueryRequest,
    decode_query_answer,
    encode_query_request,
    unpacked_samples,
)
from iort_station.cloud import Cloud
from iort_station.data import inventory
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
    request = QueryRequest(
        selection.robot,
        selection.stream,
        FIRST_US if selection.start_us is None else selection.start_us,
        LAST_US if selection.end_us is None else selection.end_us,
        selection.fields,
        selection.where,
        scan,
    )
    function = cloud.output("processing", "QueryFunction")
    parts: list[Block] = []
    there: set[str] = set()
    while True:
        answer = _invoke(cloud, function, request)
        part = _unpacked(cloud, answer)
        parts.append(part)
        there |= set(answer.fields)
        refused.count += answer.refused
        refused.named += [answer.reason] if answer.reason else []
        absent.update(answer.absent)
        if progress is not None and len(part.times_us):
            progress(answer.items, int(part.times_us[-1]))
        if answer.token is None:
            break
        request = replace(request, token=answer.token)
    if there and not selection.named() <= there:
        raise inventory.unknown_fields(cloud, selection, there)
    # A batch may overlap the next one, which another invocation may have read.
    block = ordered(join(parts))
    if len(block.times_us):
        names = selection.fields or tuple(block.columns)
        yield Block(block.times_us, {name: block.columns[name] for name in names})


def _invoke(cloud: Cloud, function: str, request: QueryRequest) -> QueryAnswer:
    reply = cloud.client("lambda").invoke(FunctionName=function, Payload=encode_query_request(request))
    text = reply["Payload"].read()
    if "FunctionError" in reply:
        message = json.loads(text).get("errorMessage", text[:500])
        raise StationError(f"the query function failed: {message}")
    try:
        answer = decode_query_answer(text)
    except ContractError as error:
        raise StationError(f"{error}: deploy the current stacks") from error
    if answer.error:
        raise StationError(f"the query function refused: {answer.error}")
    return answer


def _unpacked(cloud: Cloud, answer: QueryAnswer) -> Block:
    packed = _download(cloud, str(answer.url)) if answer.samples is None else answer.samples
    times_us, columns = unpacked_samples(packed)
    times = np.array(times_us, dtype=np.int64)
    return Block(times, {name: column_of(column) for name, column in columns.items()})


def _download(cloud: Cloud, url: str) -> bytes:
    context = ssl.create_default_context(cafile=cloud.ca_bundle)
    try:
        with urllib.request.urlopen(  # noqa: S310 - signed by our own function
            url, timeout=_DOWNLOAD_S, context=context
        ) as response:
            return bytes(response.read())
    except OSError as error:
        raise StationError(f"the result cannot be downloaded: {error}") from error
