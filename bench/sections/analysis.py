"""The proof of the analysis, on simulated cars whose parameters and faults are known.

It measures how often each of twelve faults is found at three strengths, how many findings healthy cars have,
how often the 90 % intervals hold the truth, and what the analysis takes and costs. Drives and results stay
under build/bench-analysis: an ended run goes on where it was, and a changed analysis needs no new drives.
PART measures a part of the report that is in the folder again: ``speed`` on a machine without other work,
``coverage`` the intervals and the recordings of real cars.
"""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.progress import Progress

from bench.proof import recordings, report
from bench.proof.fleet import FULL, QUICK, DriveSpec, Plan
from bench.proof.judging import TRUTHS, Analysed, Car, analysed, coverage, detection, judge, on_all_cores
from bench.report import ANALYSIS, Section
from bench.sections import Declared, Option
from testkit import ROOT
from testkit.command import progress
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

OUT = ROOT / "build" / "bench-analysis" / "report"
_ROBOT_HOURS = 1000


def run(_target: Target | None, say: Say, *, quick: int, part: str) -> list[Section]:
    """Measure all, or one part again for the report that is there."""
    say("an ended run goes on where it was")
    plan = QUICK if quick else FULL
    if part == "speed":
        return [_timed(plan)]
    with progress(Console()) as bars:
        if part == "coverage":
            return [_covered(plan, _drives(plan.covered_drives(), bars)), *recordings.sections()]
        if part:
            raise InstrumentError(f"PART={part}: allowed is speed or coverage")
        drives = _drives(list(plan.all_drives()), bars)
        judging = bars.add_task("cars judged", total=plan.cars)
        judged = on_all_cores(judge, _cars(plan, drives), lambda: bars.advance(judging))
    return [
        report.detected(plan, detection(judged)),
        report.alarms(plan, judged),
        _covered(plan, drives),
        _timed(plan),
        *recordings.sections(),
    ]


def _drives(specs: Sequence[DriveSpec], bars: Progress) -> dict[DriveSpec, Analysed]:
    driving = bars.add_task("drives simulated and analysed", total=len(specs))
    return dict(zip(specs, on_all_cores(analysed, specs, lambda: bars.advance(driving)), strict=True))


def _timed(plan: Plan) -> Section:
    hour = report.hour_cpu_s(car=0)
    ours, floor = (report.bill(_ROBOT_HOURS, cpu_s, plan.seconds) for cpu_s in (hour.cpu_s, hour.floor_s))
    return report.speed(hour, _ROBOT_HOURS, ours, floor)


def _cars(plan: Plan, drives: dict[DriveSpec, Analysed]) -> list[Car]:
    baselines = [[drives[spec] for spec in plan.baselines(car)] for car in range(plan.cars)]
    return [
        Car(
            baseline=baselines[car],
            healthy=[drives[spec] for spec in plan.healthy_drives(car)],
            faulty={case: drives[spec] for case, spec in plan.faulty_drives(car).items()},
            fleet=[
                drive.measured for other in range(plan.cars) if other != car for drive in baselines[other]
            ],
        )
        for car in range(plan.cars)
    ]


def _covered(plan: Plan, drives: dict[DriveSpec, Analysed]) -> Section:
    truths = [drives[spec] for spec in plan.covered_drives()]
    estimated = {name for drive in truths for name in drive.result.mined.estimates}
    return report.covered(plan.covered, coverage(truths), sorted(estimated - TRUTHS.keys()))


SECTION = Declared(
    "the proof of the analysis, on simulated cars with known faults",
    run,
    (
        Option("QUICK", int, 0, "a small version, to see that it works"),
        Option("PART", str, "", "speed or coverage: measure this again for the report that is in OUT"),
    ),
    ANALYSIS,
    cloud=False,
)
