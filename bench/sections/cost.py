"""The cost of a robot-hour and of large fleets, computed by the station's cost model."""

from __future__ import annotations

from dataclasses import asdict, replace

from bench.report import Section
from bench.sections import Declared
from iort_contract.cloud import PUBNUB
from iort_station.cost import model, report
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.report import Rows, times
from iort_station.cost.usage import Usage
from testkit.target import Say, Target

ROBOTS = (1, 100, 10_000, 1_000_000)
# Computed, not measured: the same settings have the same cost.
_COMPUTED = 1.01


def fleets(usage: Usage) -> Rows:
    """A column a fleet: the need of each quota as a multiple of it, and dollars a month."""
    fleets = [replace(usage, robots=robots) for robots in ROBOTS]
    needs = [{need.name: need.times for need in report.needs(fleet)} for fleet in fleets]
    head = ("needed, as a multiple of the default quota", *map(report.robots, ROBOTS))
    body: list[tuple[str, ...]] = [
        (name, *(f"**{times(of[name])}**" if of[name] > 1 else times(of[name]) for of in needs))
        for name in needs[-1]
    ]
    first = (next(iter(of.items())) for of in needs)
    body.append(("breaks first", *(name if value > 1 else "none" for name, value in first)))
    bills = {"AWS, dollars a month": model.bill}
    if usage.live_transport == PUBNUB:
        bills["PubNub by transactions, a month"] = model.pubnub_bill
    for what, bill in bills.items():
        body.append((what, *(f"{model.dollars_per_month(bill(fleet), fleet):,.0f}" for fleet in fleets)))
    return Rows(head, body)


def run(target: Target, say: Say) -> Section:
    """Compute with the deployed memory sizes and the agent's default rates."""
    say("computing")
    client = target.cloud.client("lambda")
    memory_mb = {}
    for name in ("Live", "Summarize"):
        function = target.cloud.output("processing", f"{name}Function")
        memory_mb[name] = client.get_function_configuration(FunctionName=function)["MemorySize"]
    # By the thesis' way, so that like is compared with like.
    usage = Usage(
        live_transport=PUBNUB, live_memory_mb=memory_mb["Live"], summarize_memory_mb=memory_mb["Summarize"]
    )
    section = Section("cost", "Cost a robot-hour, and scale on paper")
    for title, rows in (
        (f"Dollars a robot-hour, list prices of {AS_OF} in {REGION}", report.robot_hour(usage)),
        ("What each setting does", report.what_if(usage)),
        ("On paper: needs of AWS' default quotas", fleets(usage)),
    ):
        section.table(title, rows.head, rows.body)
    # The thesis archives and analyses nothing, so neither counts here; it pays for its live view with every
    # sample, and ours is given for both ends of the live rate.
    thesis, alike = model.total(model.thesis_bill(usage)), replace(usage, archive_days=0, drive_minutes=0.0)
    for what, rate_hz in (
        ("with the live lane at 10 Hz", 10.0),
        ("with the live lane at 1 Hz", 1.0),
        ("of the record lane alone", 0.0),
    ):
        ours = model.total(model.bill(replace(alike, watched_hours=None, live_hz=rate_hz)))
        section.ratio(f"cost {what} / a message a sample", ours / thesis, 0.05, tolerance=_COMPUTED)
    unwatched = model.total(model.bill(Usage(archive_days=0, drive_minutes=0.0, watched_hours=0.0)))
    section.ratio("unwatched robot-hour on AWS", unwatched, 0.014, unit="$", tolerance=_COMPUTED)
    section.notes.append("PubNub is apart, since its plans differ by far more than everything else here.")
    section.raw = {"usage": asdict(usage), "thesis": thesis}
    return section


SECTION = Declared("what a robot-hour costs", run)
