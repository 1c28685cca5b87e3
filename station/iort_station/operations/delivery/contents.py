"""What a stream's batches contain, as hashes that two deployments can compare."""

from __future__ import annotations

from contextlib import suppress

from iort_analysis.archive.hours import key_of
from iort_contract.archive import HASH, content_hash, item_hash
from iort_contract.dynamodb import starting_between
from iort_contract.limits import ContractError
from iort_contract.messages.batch import batch_id
from iort_contract.tables import ENVELOPE
from iort_station.cloud import Cloud
from iort_station.data.recorded import Recorded


def hashes(
    cloud: Cloud, robot: str, stream: str, first_us: int | None = None, last_us: int | None = None
) -> dict[str, str]:
    """For each run, the hash over its batches that start between two times, wherever they are stored."""
    found: dict[str, list[tuple[str, str]]] = {}
    for items in Recorded(cloud, robot, stream).items(starting_between(first_us, last_us), (*ENVELOPE, HASH)):
        for item in items:
            key = key_of(item)
            with suppress(ContractError):
                found.setdefault(batch_id(key).boot, []).append((key, item_hash(dict(item))))
    return {boot: content_hash(batches) for boot, batches in found.items()}
