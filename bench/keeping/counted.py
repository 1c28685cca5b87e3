"""What is stored and summarised of a robot, by the code of `iort audit`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.operations import accounts, audit


@dataclass(frozen=True)
class Counted:
    """The counts of a robot's streams together; ``lost`` are samples and batches that are not stored.

    ``killed_runs`` is how many runs of the agent did not end properly: what was in their open batches is no
    part of ``lost``, nor of ``incomplete``. ``summarized`` and ``expected`` are samples of the motor
    controller's stream alone.
    """

    samples: int
    batches: int
    duplicated: int
    lost: int
    incomplete: tuple[str, ...]
    killed_runs: int
    summarized: int
    expected: int


def count(cloud: Cloud, robot: str) -> Counted:
    """Audit every stream of a robot, from its first batch on."""
    told, now_us = accounts.accounts(cloud, robot), time.time_ns() // 1000
    audits = [
        accounts.held_against(
            audit.audit(name, audit.headers(cloud, robot, name), from_start=True), told, now_us
        )
        for name in inventory.known(cloud, robot)
    ]
    # A known stream of which the agent took nothing has no audit.
    audits = [one for one in audits if one.runs or one.refused or one.taken is not None]
    runs = [run for one in audits for run in one.runs]
    killed = {each.boot for one in audits for each in one.shortfalls if each.samples is None}
    known = [
        replace(one, shortfalls=tuple(each for each in one.shortfalls if each.samples is not None))
        for one in audits
    ]
    short = sum(abs(each.samples or 0) for one in known for each in one.shortfalls)
    return Counted(
        samples=sum(run.samples for run in runs),
        batches=sum(run.batches for run in runs),
        duplicated=sum(run.duplicated for run in runs),
        lost=sum(one.missing for one in audits) + short,
        incomplete=tuple(one.stream for one in known if not one.complete),
        killed_runs=len(killed),
        summarized=audit.samples_summarized(cloud, robot, VESC_STREAM),
        expected=sum(run.samples for one in audits if one.stream == VESC_STREAM for run in one.runs),
    )


def counted(cars: Mapping[str, Any]) -> dict[str, Counted]:
    """The counts of each car, from JSON."""
    return {
        name: Counted(**{**figures, "incomplete": tuple(figures["incomplete"])})
        for name, figures in cars.items()
    }
