"""Samples that the query function selects in the cloud: functions/query.py."""

from __future__ import annotations

import ssl
import urllib.request
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from iort_analysis.archive.stored import Origin, PageProgress
from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import Block, column_of, join, ordered
from iort_contract.dynamodb import with_samples_between
from iort_contract.limits import ContractError
from iort_contract.messages import questions
from iort_station.cloud import Cloud, invoke
from iort_station.data import inventory
from iort_station.data.recorded import Recorded, Selection
from iort_station.errors import StationError
from iort_station.times import iso_s

_DOWNLOAD_S = 60


def check_in_table(selection: Selection, recorded: Recorded) -> None:
    """Raise `StationError` if the query function, which reads the table only, would leave something out."""
    keys = with_samples_between(selection.start_us, selection.end_us)
    if archived := Origin(recorded.archived(keys)).within(selection.start_us, selection.end_us).told():
        raise StationError(
            f"the query function reads the table only, from which {archived['hours']:,} hours of this range "
            f"have expired, or soon will: leave out --on lambda, or start at {iso_s(archived['to_us'])}"
        )


def by_function(
    cloud: Cloud,
    selection: Selection,
    refused: RefusedItems,
    absent: Counter[str],
    *,
    scan: bool,
    progress: PageProgress | None,
) -> Iterator[Block]:
    """The selection's samples, from as many invocations of the query function as needed.

    Raises `StationError` if the function fails, and at the end for a field that no sample has.
    """
    request = questions.QueryRequest(
        selection.robot,
        selection.stream,
        questions.FIRST_US if selection.start_us is None else selection.start_us,
        questions.LAST_US if selection.end_us is None else selection.end_us,
        selection.fields,
        selection.where,
        scan,
    )
    parts: list[Block] = []
    there: set[str] = set()
    while True:
        answer = _invoke(cloud, request)
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


def _invoke(cloud: Cloud, request: questions.QueryRequest) -> questions.QueryAnswer:
    event = questions.encode_query_request(request)
    text = invoke(cloud, "processing", "QueryFunction", event, "the query function")
    try:
        answer = questions.decode_query_answer(text)
    except ContractError as error:
        raise StationError(f"{error}: deploy the current stacks") from error
    if answer.error:
        raise StationError(f"the query function refused: {answer.error}")
    return answer


def _unpacked(cloud: Cloud, answer: questions.QueryAnswer) -> Block:
    packed = _download(cloud, str(answer.url)) if answer.samples is None else answer.samples
    times_us, columns = questions.unpacked_samples(packed)
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
