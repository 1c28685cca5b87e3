"""What the event recorder's incidents cost: the requests of each, and the storage of their files. Pure."""

from __future__ import annotations

from iort_contract.messages.files import PART_BYTES
from iort_station.cost.prices import PRICES

# The samples that tell of an incident, each a batch of its own: opened, uploaded.
_SAMPLES = 2
# Seconds and gigabytes of the function that signs addresses, as of a file of one request.
_SIGNING_S, _SIGNING_GB = 0.1, 0.25


def incident_units(count: int, size: int) -> dict[str, float]:
    """The units by the price's name of ``count`` incidents of ``size`` bytes in all, stored for a month."""
    parts = max(count, -(-size // PART_BYTES))
    return {
        # The question for addresses and its answer; the samples pass by Basic Ingest.
        "message": 2.0 * count,
        "rule": (1.0 + _SAMPLES) * count,
        "action": (1.0 + _SAMPLES) * count,
        "write": float(_SAMPLES * count),
        "invocation": float(count),
        "compute_arm": _SIGNING_S * _SIGNING_GB * count,
        # A file of several parts is begun and completed, too.
        "s3_put": float(parts + 2 * count),
        "s3_standard": size / 1e9,
    }


def incident_dollars(count: int, size: int) -> tuple[float, float]:
    """Dollars to upload incidents, and to store their files for a month."""
    units = incident_units(count, size)
    stored = units.pop("s3_standard") * PRICES["s3_standard"].each
    return sum(amount * PRICES[name].each for name, amount in units.items()), stored
