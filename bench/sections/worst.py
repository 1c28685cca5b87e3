"""What the most expensive batches cost Lambda 2, without its tables. Each fits into a message."""

from __future__ import annotations

import time
import tracemalloc
from typing import NamedTuple

from bench.report import Report, Section
from bench.sections import Declared
from iort_contract.limits import ContractError
from iort_contract.messages.batch import decode_batch
from iort_contract.statistics import summarize_second
from testkit.target import Say, Target
from testkit.worst_case import cases

_TIMES = 5
WORST = Report("worst", "The most expensive batches", "make bench ONLY=worst")


class Cost(NamedTuple):
    """The least processor time of a few runs in ms, the memory held in MB, and why it was refused, if so."""

    ms: float
    held_mb: float
    refused: str


def measure(message: bytes) -> Cost:
    """Measure Lambda 2's work on a message, without its tables."""
    refused, spent_ms = "", []
    for _ in range(_TIMES):
        began = time.process_time()
        try:
            batch = decode_batch(message)
            summarize_second(batch.t_us // 1_000_000, [batch], None)
        except ContractError as error:
            refused = str(error)
        spent_ms.append((time.process_time() - began) * 1000)
    return Cost(min(spent_ms), 0.0 if refused else _held_mb(message), refused)


def _held_mb(message: bytes) -> float:
    tracemalloc.start()
    try:
        batch = decode_batch(message)
        held, _ = tracemalloc.get_traced_memory()
        del batch
    finally:
        tracemalloc.stop()
    return held / 1e6


def run(_target: Target | None, say: Say) -> Section:
    """Decode and summarise each batch on one core."""
    section = Section("worst", "The most expensive batches")
    rows = []
    for case in cases():
        say(case.what)
        cost, size = measure(case.message), len(case.message) / 1024
        figures = f"{size:.1f} KB", f"{cost.ms:.0f} ms", f"{cost.held_mb:.1f} MB", cost.refused[:40]
        rows.append([case.what, *figures])
        section.raw[case.what] = cost._asdict()
    section.table(
        "Decoded and summarised", ["batch", "on the wire", "processor time", "held", "refused"], rows
    )
    return section


SECTION = Declared(
    "the most expensive batches",
    run,
    report=WORST,
    cloud=False,
)
