"""The sections of the report, a file each, in the order in which they run."""

from __future__ import annotations

from collections.abc import Callable

from bench.report.result import Section
from bench.sections import (
    abilities,
    command,
    cost,
    dashboard,
    fairness,
    mixed,
    outage,
    query,
    round_trips,
    scale,
    utilisation,
    viewing,
)
from testkit.target import Say, Target

Run = Callable[[Target, Say], Section]

SECTIONS: dict[str, Run] = {
    "round_trips": round_trips.run,
    "dashboard": dashboard.run,
    "viewing": viewing.run,
    "utilisation": utilisation.run,
    "query": query.run,
    "command": command.run,
    "abilities": abilities.run,
    "cost": cost.run,
    "outage": outage.run,
    "scale": scale.run,
    "mixed": mixed.run,
    "fairness": fairness.run,
}
