"""What an import of recordings costs: the requests, and the storage. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from iort_station.cost.model import ARCHIVED_SHARE, READ, WRITE, units
from iort_station.cost.prices import MONTH_DAYS, PRICES

# A recording's bytes in a batch: compressed, and in base64.
_BATCH_SHARE = 0.6
_SECOND_UNITS = 1


@dataclass(frozen=True)
class Imported:
    """What comes into the table or the archive: seconds and hours of all streams together, and the bytes of
    the recordings."""

    seconds: float
    stream_hours: int
    size: int


def table_units(one: Imported, retention_days: float) -> dict[str, float]:
    """The units by the price's name of batches that go into the table."""
    item = one.size * _BATCH_SHARE / max(1.0, one.seconds)
    return {
        # Batch and second; Lambda 2 and the archive read the batch.
        "write": one.seconds * (units(item, WRITE) + _SECOND_UNITS),
        "read": 3 * one.seconds * units(item, READ),
        "invocation": one.seconds / 100,
        "compute_arm": one.seconds * 0.005,
        "storage": one.size * _BATCH_SHARE / 1e9 * retention_days / MONTH_DAYS,
    }


def archive_units(one: Imported) -> dict[str, float]:
    """The units of hours that go straight into the archive; a day is joined later."""
    return {
        "s3_put": 2.0 * one.stream_hours,
        "s3_get": 4.0 * one.stream_hours,
        "write": 6.0 * one.stream_hours,
        "read": 4.0 * one.stream_hours,
        "s3_standard": one.size * ARCHIVED_SHARE / 1e9,
    }


def dollars(amounts: dict[str, float]) -> tuple[float, float]:
    """Dollars once, and dollars of storage: of the archive for a month, of the table until it expires."""
    stored = sum(amounts.get(name, 0.0) * PRICES[name].each for name in ("storage", "s3_standard"))
    once = sum(amount * PRICES[name].each for name, amount in amounts.items()) - stored
    return once, stored
