"""`make bench-fleet`: the load of many robots on the embedded cloud, and its cost.

    python -m bench.fleet [--robots 200] [--seconds 300] [--rate 50] [--json FILE]
    python -m bench.fleet --limit [--seconds 60] [--rate 50]

Every robot has a certificate and a session of its own and sends a batch of 50 samples a second, through
the record rule into the telemetry table, whose stream Lambda 2 summarises. What was stored and summarised
is counted in the tables, batch by batch, against what was sent; exit status 1 if a sample is missing.

With ``--limit`` the number of robots grows until summaries are late, and the largest number that keeps up is
looked for. Other programs on the machine lower it; the processor time for a batch hardly depends on them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from bench.load.fleet.figures import Fleet, limits, table
from bench.load.fleet.run import measure
from local.cloud import EmbeddedCloud
from local.processes import LocalError
from testkit.command import made, parser, steps, write
from testkit.waiting import InstrumentError


def main() -> None:
    """Measure and print; exit status 1 if anything is missing or out of order."""
    arguments = parser(__doc__)
    arguments.add_argument("--robots", type=int, nargs="+", default=[200], help="one run for each number")
    arguments.add_argument("--seconds", type=int, default=300, help="how long they drive")
    arguments.add_argument("--rate", type=int, default=50, help="samples a second of each")
    arguments.add_argument("--limit", action="store_true", help="look for the largest number that keeps up")
    options = arguments.parse_args()
    console = Console()
    say = steps(console)
    runs: list[Fleet] = []
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            EmbeddedCloud(Path(folder) / "cloud", progress=say) as embedded,
        ):

            def drive(count: int) -> Fleet:
                prefix = f"bench-{len(runs)}"
                runs.append(
                    measure(embedded, count, options.seconds, say, rate_hz=options.rate, prefix=prefix)
                )
                table(runs[-1:]).show(console)
                return runs[-1]

            if options.limit:
                look_for(drive, options.robots[0])
                limits(runs).show(console)
            else:
                for count in options.robots:
                    drive(count)
    except (InstrumentError, LocalError) as error:
        sys.exit(f"bench-fleet: {error}")
    write(options.json, {**made(), "runs": [run.as_json() for run in runs]})
    sys.exit(0 if all(run.good for run in runs if run.keeps_up or not options.limit) else 1)


def look_for(drive: Callable[[int], Fleet], robots: int) -> int:
    """The largest number of robots that keeps up, to a tenth; ``robots`` is where the search begins."""
    keeps, late = 0, 0
    while not late or late - keeps > max(1, late // 10):
        if drive(robots).keeps_up:
            keeps = robots
        else:
            late = robots
        robots = (keeps + late) // 2 if late else keeps * 2
    return keeps


if __name__ == "__main__":
    main()
