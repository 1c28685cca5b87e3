"""What the nightly analysis of drives takes on AWS: docs/explanation/analysis.md. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace

from iort_station.cost.bill.line_items import PLATFORM_LINES, READ, LineItem
from iort_station.cost.sizes import sizes_of
from iort_station.cost.usage import Usage

LANE = "analysis"
# A function has a whole processor from this memory on ("Configure Lambda function memory").
MB_PER_CPU = 1769
# A robot-hour with 180,000 samples took 1.6 s of this project's test machine, as `make bench-analysis`
# measures it; its results were 0.5 MB, which are kept, here counted for a year.
_SAMPLE_S, _SAMPLE_BYTES, _KEPT_MONTHS = 1.6 / 180_000, 5e5 / 180_000, 12
# States of a run, besides one for each robot and one for each drive; three of them call a function.
_STATES, _CALLS = 5, 3
# Both days are looked at every night.
_PLANNED = 2
# Rows of earlier drives with which a robot's are compared, a read unit each: its own, and the others'.
_COMPARED = 320
_LINE = 260


@dataclass(frozen=True)
class Function:
    """The function that analyses a drive, as stacks/analysis.py deploys it: its memory, how many run at once,
    and the seconds, units and objects that a drive takes besides the analysis, for reading and writing.

    Each is an express workflow of the distributed map.
    """

    memory_mb: int = MB_PER_CPU
    at_once: int = 40
    drive_s: float = 1.0
    written_units: int = 4
    objects: int = 5
    workflow_mb: int = 64

    def billed_s(self, cpu_s: float) -> float:
        """Billed seconds of a drive whose analysis takes a whole processor ``cpu_s``; a share of the memory
        that has one is a share of it."""
        return cpu_s * max(1.0, MB_PER_CPU / self.memory_mb) + self.drive_s


def drive_items(usage: Usage, drives: float, billed_s: float, function: Function) -> list[LineItem]:
    """The line items of ``drives`` in a robot-hour, each of ``billed_s`` seconds."""
    one_stream = replace(usage, streams=1)
    return [
        _item("Lambda", "computing", "compute_arm", drives * billed_s * function.memory_mb / 1024),
        _item("Lambda", "invoked", "invocation", drives),
        _item("Step Functions", "a state for each drive", "transition", drives),
        _item("Step Functions", "express workflows", "express_request", drives),
        _item(
            "Step Functions",
            "their duration",
            "express_duration",
            drives * billed_s * function.workflow_mb / 1024,
        ),
        _item("DynamoDB", "samples read", "read", read_units(usage)),
        # The stream that tells of motion.
        _item("DynamoDB", "samples read to find the drives", "read", _PLANNED * read_units(one_stream)),
        _item("DynamoDB", "results written", "write", drives * function.written_units),
        _item("S3", "results written, PUT", "s3_put", drives * function.objects),
        _item("S3", "results read, GET", "s3_get", drives),
    ]


def items(usage: Usage) -> list[LineItem]:
    """The line items of a robot-hour whose drives are analysed in the next night; none without analysis."""
    if not usage.drive_minutes:
        return []
    one = Function()
    drives = 60 / usage.drive_minutes
    cpu_s = _SAMPLE_S * usage.samples_per_s * 60 * usage.drive_minutes
    # A night of a robot, and its share of the run.
    nights = 1 / usage.hours_per_day
    runs = nights / usage.robots
    calls = nights + _CALLS * runs
    logged = _LINE * (drives + calls)
    if usage.function_logs == "all":
        logged += len(PLATFORM_LINES) * (drives + calls)
    return [
        *drive_items(usage, drives, one.billed_s(cpu_s), one),
        _item("Lambda", "planning and comparing", "compute_arm", calls * one.drive_s * one.memory_mb / 1024),
        _item("Lambda", "planning and comparing, invoked", "invocation", calls),
        _item("CloudWatch", "logging", "logs", logged / 1e9),
        _item(
            "Step Functions", "states of the run, and of each robot", "transition", nights + _STATES * runs
        ),
        _item("DynamoDB", "earlier drives read", "read", nights * _COMPARED),
        _item(
            "S3",
            "results kept",
            "s3_standard",
            _SAMPLE_BYTES * 3600 * usage.samples_per_s / 1e9 * _KEPT_MONTHS,
        ),
        _item("S3", "plans, PUT", "s3_put", nights),
        _item("EventBridge", "scheduled", "schedule", runs),
    ]


def read_units(usage: Usage) -> float:
    """The read units of a robot-hour's batches: the functions read them strongly consistent."""
    item = sizes_of(usage.rate_hz, usage.batch_s).telemetry_item
    return usage.batches_per_s * 3600 * item / READ


def _item(service: str, what: str, price: str, units: float) -> LineItem:
    return LineItem(service, LANE, what, price, units)
