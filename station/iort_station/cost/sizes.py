"""The sizes of messages and items, as measured by `python -m bench.meters.message_sizes`.

The command encodes a simulated drive with the agent's code; a test compares this table with it.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import NamedTuple

# The telemetry item of one sample of the agent's metrics.
OWN_ITEM_BYTES = 236
# The archive's Parquet beside the items that are in it, of an hour that is driven from end to end.
ARCHIVED_SHARE = 0.60


class Measured(NamedTuple):
    """Bytes of a batch's message and item, and of a second's summary, by their number of samples."""

    samples: int
    record: int
    telemetry_item: int
    summary_item: int


# One second with this many samples. In a shorter batch above 50 Hz values change less between samples, so it
# is up to a quarter smaller than in this table.
TABLE = (
    Measured(1, 257, 240, 383),
    Measured(2, 281, 264, 540),
    Measured(5, 337, 320, 557),
    Measured(10, 398, 380, 552),
    Measured(20, 498, 480, 573),
    Measured(50, 734, 716, 589),
    Measured(100, 1043, 1024, 586),
    Measured(200, 1551, 1532, 587),
    Measured(500, 3087, 3068, 580),
    Measured(1000, 5444, 5424, 576),
    Measured(2000, 10368, 10348, 600),
)


@dataclass(frozen=True)
class Sizes:
    """Bytes of messages with their topics, as AWS meters them, and of items with names and values.

    ``sample`` is one sample as a flat JSON message.
    """

    record: int
    telemetry_item: int
    summary_item: int
    live: int = 402
    ping: int = 71
    update: int = 480
    sample: int = 356
    sample_item: int = 277


def sizes_of(rate_hz: float, batch_s: float) -> Sizes:
    """The sizes for a VESC's stream at this rate, in batches of this length."""
    batch = _interpolated(rate_hz * batch_s)
    return Sizes(
        record=batch.record,
        telemetry_item=batch.telemetry_item,
        summary_item=_interpolated(rate_hz).summary_item,
    )


def _interpolated(samples: float) -> Measured:
    """The sizes for a number of samples, interpolated between the two nearest rows."""
    rounded = min(max(1, round(samples)), TABLE[-1].samples)
    i = bisect_left(TABLE, (rounded,))
    above, below = TABLE[i], TABLE[max(0, i - 1)]
    if above.samples == rounded:
        return above
    share = (rounded - below.samples) / (above.samples - below.samples)
    return Measured(*(round(low + share * (high - low)) for low, high in zip(below, above, strict=True)))
