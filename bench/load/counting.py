"""What arrived of a drive, counted with the code of `iort audit`; and the words of a process that drives."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import SECOND
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.recorded import summary_table, topic_of
from iort_station.operations import accounts, audit
from testkit import ROOT
from testkit.waiting import InstrumentError


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
    account, now_us = accounts.accounts(cloud, robot), time.time_ns() // 1000
    stored = (
        audit.audit(name, audit.headers(cloud, robot, name), from_start=True)
        for name in inventory.known(cloud, robot)
    )
    audits = [accounts.held_against(each, account, now_us) for each in stored]
    # A known stream of which the agent took nothing has no audit.
    audits = [each for each in audits if each.runs or each.refused or each.taken is not None]
    runs = [run for each in audits for run in each.runs]
    known = [
        replace(each, shortfalls=tuple(short for short in each.shortfalls if short.samples is not None))
        for each in audits
    ]
    short = sum(abs(short.samples or 0) for each in known for short in each.shortfalls)
    return Counted(
        samples=sum(run.samples for run in runs),
        batches=sum(run.batches for run in runs),
        duplicated=sum(run.duplicated for run in runs),
        lost=sum(each.missing for each in audits) + short,
        incomplete=tuple(each.stream for each in known if not each.complete),
        killed_runs=len(
            {short.boot for each in audits for short in each.shortfalls if short.samples is None}
        ),
        summarized=audit.samples_summarized(cloud, robot, VESC_STREAM),
        expected=sum(run.samples for each in audits if each.stream == VESC_STREAM for run in each.runs),
    )


def summarized_ends(cloud: Cloud, robot: str) -> list[int]:
    """The first and the last summarised second of a robot; empty if it has none."""
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)
    ends = (table.first(topic, newest=newest, attributes=(SECOND,)) for newest in (False, True))
    return [int(item[SECOND]["N"]) for item in ends if item is not None]


@contextmanager
def process(
    module: str, *arguments: str, environment: Mapping[str, str] | None = None
) -> Iterator[Iterator[dict[str, Any]]]:
    """Run a module that writes a JSON object a line, and yield the objects; it is ended at the end.

    Raises `InstrumentError` where its output is read to the end of a failure.
    """
    command = [sys.executable, "-m", module, *arguments]

    def objects() -> Iterator[dict[str, Any]]:
        yield from map(json.loads, running.stdout or ())
        if running.wait():
            raise InstrumentError(f"{module} ended with status {running.returncode}")

    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield objects()
        finally:
            running.kill()
