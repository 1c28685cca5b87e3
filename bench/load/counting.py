"""What arrived of a drive; and the words of a process that drives."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from iort_agent.errors import AgentError
from iort_agent.status import fetch
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import SECOND
from iort_station.cloud import Cloud
from iort_station.data.recorded import summary_table, topic_of
from testkit import ROOT
from testkit.waiting import InstrumentError, reached


def summarized_ends(cloud: Cloud, robot: str) -> list[int]:
    """The first and the last summarised second of a robot; empty if it has none."""
    table, topic = summary_table(cloud), topic_of(cloud, robot, VESC_STREAM)
    ends = (table.first(topic, newest=newest, attributes=(SECOND,)) for newest in (False, True))
    return [int(item[SECOND]["N"]) for item in ends if item is not None]


def await_received(socket: Path, enough: Callable[[Mapping[str, int]], bool], *, within_s: float) -> None:
    """Wait until an agent has received ``enough`` samples, by stream, or for so long that some must be
    lost."""

    def received() -> bool:
        with suppress(AgentError):  # it is too busy to answer
            streams = fetch(socket)["streams"]
            return enough({stream: one["samples"] for stream, one in streams.items()})
        return False

    reached(received, within_s=within_s, poll_s=0.2)


def finish(process: subprocess.Popen[str], number: signal.Signals, *, within_s: float) -> None:
    """End a process by a signal. Raises `InstrumentError` if it does not end."""
    process.send_signal(number)
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired as error:
        raise InstrumentError(f"{process.args!r:.80} did not end") from error


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
