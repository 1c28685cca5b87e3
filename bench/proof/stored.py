"""A simulated drive as the items of the telemetry table: a batch a second."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from bench.proof.cars import DriveSpec
from bench.proof.drives import simulated
from iort_analysis.samples.blocks import Block, values
from iort_contract.dynamodb import Item
from iort_contract.messages.batch import Batch
from testkit.dynamodb import item_of

_S = 1_000_000


def stored(spec: DriveSpec) -> dict[str, list[Item]]:
    """The stored batches of a drive by stream."""
    return {
        stream: [
            item_of(
                Batch(
                    spec.key.run,
                    seq,
                    part.times_us.tolist(),
                    {name: values(column) for name, column in part.columns.items()},
                )
            )
            for seq, part in enumerate(_by_second(block))
        ]
        for stream, block in simulated(spec).streams.items()
    }


def _by_second(block: Block) -> list[Block]:
    seconds = (block.times_us - block.times_us[0]) // _S
    edges = np.searchsorted(seconds, np.arange(int(seconds[-1]) + 2)).tolist()
    return [block.take(slice(a, b)) for a, b in pairwise(edges) if a < b]
