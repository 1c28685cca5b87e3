"""`make bench-analysis`: the proof of the analysis, on simulated cars whose parameters and faults are known.

    python -m bench.analysis [--quick] [--only speed | coverage] [--out build/bench-analysis]

It measures how often each of twelve faults is found at three strengths, how many findings healthy cars have,
how often the 90 % intervals hold the truth, and what the analysis takes and costs. Drives and results stay
under build/bench-analysis: an ended run goes on where it was, and a changed analysis needs no new drives. The
exit status is 1 if a target is missed. ``--only`` measures a part of the report that is in the folder again:
``speed`` on a machine without other work, ``coverage`` the intervals and the recordings of real cars.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from bench.proof import recordings, report, speed
from bench.proof.analysing import Analysed, analysed, on_all_cores
from bench.proof.cars import DriveSpec
from bench.proof.judging import Car, coverage, detection, judge
from bench.proof.plan import FULL, QUICK, Plan
from bench.proof.truths import TRUTHS
from bench.report import writer
from bench.report.result import Section
from testkit import ROOT, machine
from testkit.command import progress

OUT = ROOT / "build" / "bench-analysis" / "report"
_ROBOT_HOURS = 1000


def main() -> None:
    """Measure, write the report and print its headline."""
    options = _options()
    console = Console()
    began = time.monotonic()
    here = machine.describe()
    try:
        if options.only:
            sections, measured = writer.read(options.out, writer.ANALYSIS)
            again = {section.key: section for section in _again(options.only, console)}
            for section in again.values():
                section.notes.append(f"Measured again on {here['date'][:10]}, commit {here['commit']}.")
            sections = [again.get(section.key, section) for section in sections]
            here = measured
        else:
            sections = _measure(QUICK if options.quick else FULL, console)
    except KeyboardInterrupt:
        console.print("ended; the same command goes on from here", style="yellow")
        sys.exit(130)
    writer.write(options.out, sections, here, "simulated cars", writer.ANALYSIS)
    for section in sections:
        for table in section.tables:
            table.show(console)
    writer.headline(sections).show(console)
    console.print(
        f"{options.out / writer.ANALYSIS.name}.md  after {time.monotonic() - began:.0f} s", highlight=False
    )
    sys.exit(1 if any(r.reached is False for s in sections for r in s.ratios) else 0)


def _measure(plan: Plan, console: Console) -> list[Section]:
    with progress(console) as bars:
        drives = _drives(list(plan.all_drives()), bars)
        judging = bars.add_task("cars judged", total=plan.cars)
        judged = on_all_cores(judge, _cars(plan, drives), lambda: bars.advance(judging))
        hours = bars.add_task("hours timed", total=1)
        timed = _timed(plan)
        bars.advance(hours)
    return [
        report.detected(plan, detection(judged)),
        report.alarms(plan, judged),
        _covered(plan, drives),
        timed,
        *_recordings(),
    ]


def _again(part: str, console: Console) -> list[Section]:
    if part == "speed":
        return [_timed(FULL)]
    with progress(console) as bars:
        drives = _drives(FULL.covered_drives(), bars)
    return [_covered(FULL, drives), *_recordings()]


def _drives(specs: Sequence[DriveSpec], bars: Progress) -> dict[DriveSpec, Analysed]:
    driving = bars.add_task("drives simulated and analysed", total=len(specs))
    return dict(zip(specs, on_all_cores(analysed, specs, lambda: bars.advance(driving)), strict=True))


def _timed(plan: Plan) -> Section:
    hour = speed.hour_cpu_s(car=0)
    ours, floor = (speed.bill(_ROBOT_HOURS, cpu_s, plan.seconds) for cpu_s in (hour.cpu_s, hour.floor_s))
    return report.speed(hour, _ROBOT_HOURS, ours, floor)


def _cars(plan: Plan, drives: dict[DriveSpec, Analysed]) -> list[Car]:
    baselines = [[drives[spec] for spec in plan.baselines(car)] for car in range(plan.cars)]
    return [
        Car(
            baseline=baselines[car],
            healthy=[drives[spec] for spec in plan.healthy_drives(car)],
            faulty={case: drives[spec] for case, spec in plan.faulty_drives(car).items()},
            fleet=[one.measured for other in range(plan.cars) if other != car for one in baselines[other]],
        )
        for car in range(plan.cars)
    ]


def _covered(plan: Plan, drives: dict[DriveSpec, Analysed]) -> Section:
    truths = [drives[spec] for spec in plan.covered_drives()]
    estimated = {name for drive in truths for name in drive.result.mined.estimates}
    return report.covered(plan.covered, coverage(truths), sorted(estimated - TRUTHS.keys()))


def _recordings() -> list[Section]:
    real = recordings.section()
    return [] if real is None else [real]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make bench-analysis", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small version, to see that it works")
    parser.add_argument(
        "--only", choices=("speed", "coverage"), help="measure this again for the report that is there"
    )
    parser.add_argument("--out", type=Path, default=OUT, metavar="FOLDER")
    options = parser.parse_args()
    if options.only and not (options.out / f"{writer.ANALYSIS.name}.json").exists():
        parser.error(f"--only needs a report in {options.out}: without it, one is made")
    return options


if __name__ == "__main__":
    main()
