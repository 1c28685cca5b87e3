"""`make bench-fleet`: the load of many robots on the embedded cloud, and its cost.

    python -m bench.fleet [--robots 200] [--seconds 300] [--json FILE]

Every robot has a certificate and a session of its own and sends a batch of 50 samples a second, through
the record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised
is counted in the tables, batch by batch, against what was sent; exit status 1 if a sample is missing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench.errors import BenchError
from bench.load.fleet_arrivals import Tell
from bench.load.fleet_run import Fleet, measure
from local.cloud import EmbeddedCloud
from local.errors import LocalError

# How often progress prints a line, without a terminal.
_SAY_S = 5.0


def as_table(fleet: Fleet) -> Table:
    """Return the figures as a table to print."""
    table = Table(title=f"{fleet.robots} robots, {fleet.seconds} s", title_justify="left", title_style="bold")
    table.add_column("figure")
    table.add_column("", justify="right")
    for name, value in (
        ("batches sent", f"{fleet.batches_sent:,}"),
        ("batches stored", f"{fleet.batches_stored:,}"),
        ("samples sent", f"{fleet.samples_sent:,}"),
        ("samples summarised", f"{fleet.samples_summarized:,}"),
        ("samples lost", f"{fleet.samples_lost:,}"),
        ("topics out of order", str(fleet.topics_out_of_order)),
        ("sent again, sessions lost", f"{fleet.resent}, {fleet.lost_sessions}"),
        ("robot to rule", str(fleet.delay_ms)),
        ("robot to acknowledgement", str(fleet.ack_ms)),
        ("summary behind by", f"{fleet.summary_behind_s.p50} s (p95 {fleet.summary_behind_s.p95})"),
        ("Lambda 2 done after the last batch", f"{fleet.catch_up_s} s"),
        *((f"CPU, {name}", f"{percent} % of a core") for name, percent in fleet.cpu_percent.items()),
        *((f"memory, {name}", f"{mb} MB") for name, mb in fleet.rss_mb.items()),
    ):
        table.add_row(name, value)
    return table


@contextmanager
def progress(console: Console) -> Iterator[Tell]:
    """Show a bar for each step of `measure`, or without a terminal a line every few seconds."""
    if not console.is_terminal:
        yield _lines(console)
        return
    with Progress(console=console, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def tell(share: float, what: str) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=share)

        yield tell


def _lines(console: Console) -> Tell:
    last = ("", 0.0)

    def tell(share: float, what: str) -> None:
        nonlocal last
        if what != last[0] or time.monotonic() - last[1] >= _SAY_S:
            last = (what, time.monotonic())
            console.print(f"  {what}: {share:.0%}", style="dim")

    return tell


def main() -> None:
    """Measure and print; exit status 1 if anything is missing or out of order."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[200], help="one run for each number")
    parser.add_argument("--seconds", type=int, default=300, help="how long they drive")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON too")
    options = parser.parse_args()
    console, runs = Console(), []
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            EmbeddedCloud(
                Path(folder) / "cloud", progress=lambda step: console.print(f"  {step}", style="dim")
            ) as embedded,
        ):
            for count in options.robots:
                with progress(console) as tell:
                    runs.append(measure(embedded, count, options.seconds, tell))
                console.print(as_table(runs[-1]))
    except (BenchError, LocalError) as error:
        sys.exit(f"bench-fleet: {error}")
    if options.json:
        report = {
            "at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "machine": {"cores": os.cpu_count(), "python": platform.python_version()},
            "load_1min": os.getloadavg()[0],
            "runs": [run.as_json() for run in runs],
        }
        options.json.write_text(json.dumps(report, indent=2) + "\n")
    sys.exit(0 if all(run.good for run in runs) else 1)


if __name__ == "__main__":
    main()
