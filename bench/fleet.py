"""`make bench-fleet`: the load of many robots on the embedded cloud, and its cost.

    python -m bench.fleet [--robots 200] [--seconds 300] [--json FILE]

Every robot has a certificate and a session of its own and sends a batch of 50 samples a second, through
the record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised
is counted in the tables, batch by batch, against what was sent; exit status 1 if a sample is missing.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from rich.console import Console

from bench.command import made, parser, write
from bench.errors import BenchError
from bench.load.fleet_figures import table
from bench.load.fleet_run import measure
from local.cloud import EmbeddedCloud
from local.errors import LocalError


def main() -> None:
    """Measure and print; exit status 1 if anything is missing or out of order."""
    arguments = parser(__doc__)
    arguments.add_argument("--robots", type=int, nargs="+", default=[200], help="one run for each number")
    arguments.add_argument("--seconds", type=int, default=300, help="how long they drive")
    options = arguments.parse_args()
    console, runs = Console(), []

    def say(step: str) -> None:
        console.print(f"  {step}", style="dim", highlight=False)

    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            EmbeddedCloud(Path(folder) / "cloud", progress=say) as embedded,
        ):
            for count in options.robots:
                runs.append(measure(embedded, count, options.seconds, say))
                table(runs[-1:]).show(console)
    except (BenchError, LocalError) as error:
        sys.exit(f"bench-fleet: {error}")
    write(options.json, {**made(), "runs": [run.as_json() for run in runs]})
    sys.exit(0 if all(run.good for run in runs) else 1)


if __name__ == "__main__":
    main()
