"""Fleets of several sizes side by side: what each needs of AWS' default quotas, and dollars a month."""

from __future__ import annotations

from dataclasses import replace

from iort_contract.cloud import PUBNUB
from iort_station.cost.report import Rows, Scale, on_paper, times
from iort_station.cost.usage import Usage

ROBOTS = (1, 100, 10_000, 1_000_000)


def fleets(usage: Usage) -> Rows:
    """A column a fleet: the need of each quota as a multiple of it, and dollars a month."""
    scales = [on_paper(replace(usage, robots=robots)) for robots in ROBOTS]
    head = (
        "needed, as a multiple of the default quota",
        *(f"{scale.robots:,} robot{'s' * (scale.robots > 1)}" for scale in scales),
    )
    body: list[tuple[str, ...]] = []
    for need in scales[-1].needs:
        needs = [next(n.times for n in scale.needs if n.name == need.name) for scale in scales]
        body.append((need.name, *(f"**{times(value)}**" if value > 1 else times(value) for value in needs)))
    body.append(("breaks first", *(_first(scale) for scale in scales)))
    body.append(("AWS, dollars a month", *(f"{scale.aws_dollars_per_month:,.0f}" for scale in scales)))
    if usage.live_transport == PUBNUB:
        dollars = (f"{scale.pubnub_dollars_per_month:,.0f}" for scale in scales)
        body.append(("PubNub by transactions, a month", *dollars))
        body.append(("PubNub, publishes/s", *(f"{scale.pubnub_publishes_per_s:,.0f}" for scale in scales)))
    return Rows(head, body)


def _first(scale: Scale) -> str:
    return scale.breaks_first.name if scale.breaks_first.times > 1 else "none"
