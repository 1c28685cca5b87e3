"""`make bench-kept`: the kept cloud is killed at random moments of a drive, and lives through a week.

    python -m bench.kept [--kills 50] [--soak 168] [--minutes 4] [--out docs/bench]

First five cars drive at 50 Hz while the emulator, its functions, all processes of `make up`, or an agent get
SIGKILL, or the cloud's disk is full; the code of `iort audit` then counts what is lost. Then five cars drive
in every hour of a week on a clock that is set forward, and the cloud's memory is measured. Exit status 1 if a
sample is missing, or if the memory grows.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console

from bench.keeping import kills, report, week
from iort_station.errors import StationError
from local.processes import LocalError
from testkit import machine
from testkit.command import made, parser, steps, wound_up, write
from testkit.waiting import InstrumentError


def main() -> None:
    """Measure, and print."""
    arguments = parser(__doc__)
    arguments.add_argument("--kills", type=int, default=50, help="0: none")
    arguments.add_argument(
        "--soak", type=int, default=168, metavar="HOURS", help="hours of the clock; 0: none"
    )
    arguments.add_argument("--minutes", type=int, default=4, help="how long each car drives in each hour")
    arguments.add_argument("--seed", type=int, default=time.time_ns() % 2**32, help="of the random moments")
    arguments.add_argument("--out", type=Path, help="write the report, the plot and the figures here")
    given = arguments.parse_args()
    machine.enter("bench.kept")
    console = Console()
    say = steps(console)
    killed = soaked = None
    try:
        with wound_up(console), tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            if given.kills:
                killed = kills.drive(Path(folder) / "kills", given.kills, given.seed, say)
                killed.table().show(console)
            if given.soak:
                soaked = week.soak(Path(folder) / "soak", given.soak, given.minutes, say)
                soaked.table().show(console)
    except (InstrumentError, LocalError, StationError) as error:
        sys.exit(f"bench-kept: {error}")
    except KeyboardInterrupt:
        sys.exit("bench-kept: ended")
    figures = {**made(), "kills": killed and killed.as_json(), "soak": soaked and soaked.as_json()}
    write(given.json, figures)
    if given.out:
        report.write(given.out, killed, soaked, figures["machine"])
    sys.exit(0 if all(one.good for one in (killed, soaked) if one) else 1)


if __name__ == "__main__":
    main()
