"""The last report of each run of a robot's agent, without reading all of its reports."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from iort_analysis.samples.batches import ATTRIBUTES, Item
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.dynamodb import starting_between
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.batch import BatchId, batch_id
from iort_contract.tables import BATCH, RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.data.stored.recorded import Recorded


def last_reports(cloud: Cloud, robot: str) -> Iterator[Item]:
    """The stored items with the last report of each run, and others beside them. A report counts from the
    start of its run, so that the earlier ones say nothing more."""
    recorded = Recorded(cloud, robot, ACCOUNT_STREAM)
    last: dict[str, BatchId] = {}
    for item in recorded.headers(starting_between(None, None)):
        with suppress(ContractError):
            one = batch_id(item[BATCH]["S"])
            # Its number decides, since the car's clock may be set back.
            if one.boot not in last or last[one.boot].seq <= one.seq:
                last[one.boot] = one
    for one in last.values():
        # An agent that does not batch sends a report in several messages.
        keys = starting_between(one.t_us - MAX_BATCH_SPAN_US, one.t_us)
        for items in recorded.items(keys, (*ATTRIBUTES, RECEIVED_MS)):
            yield from items
