"""What arrived of a drive; and the words of a process that drives."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import SECOND
from iort_station.cloud import Cloud
from iort_station.data.recorded import summary_table, topic_of
from testkit import ROOT
from testkit.waiting import InstrumentError


def summarized_ends(cloud: Cloud, robot: str) -> list[int]:
    """The first and the last summarised second of a robot; empty if it has none."""
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)
    ends = (table.first(topic, newest=newest, attributes=(SECOND,)) for newest in (False, True))
    return [int(item[SECOND]["N"]) for item in ends if item is not None]


@contextmanager
def process(module: str, *arguments: str) -> Iterator[Iterator[dict[str, Any]]]:
    """Run a module that writes a JSON object a line, and yield the objects; it is ended at the end.

    Raises `InstrumentError` where its output is read to the end of a failure.
    """
    command = [sys.executable, "-m", module, *arguments]

    def objects() -> Iterator[dict[str, Any]]:
        yield from map(json.loads, running.stdout or ())
        if running.wait():
            raise InstrumentError(f"{module} ended with status {running.returncode}")

    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield objects()
        finally:
            running.kill()
