"""`make bench-analysis-cloud`: robot-hours through the deployed analysis, on an embedded cloud of its own.

    python -m bench.analysed_fleet [--hours 50] [--json FILE]

Every robot has an hour of a simulated car, its motor controller at 50 Hz and its poses. The batches are
written to the telemetry table, and the state machine analyses them as at night, with its progress shown.
Lambda 2, which would summarise them all, is switched off. The processor time is that of the functions'
processes, with their imports. Exit status 1 if a drive was not analysed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console

from bench.proof.cars import drive_of
from bench.proof.speed import HOUR_S
from bench.proof.stored import stored
from iort_contract.dynamodb import Item, TelemetryTable
from iort_contract.messages.analysis import AnalysisRequest
from iort_contract.tables import ROBOT, SAMPLES, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.errors import StationError
from iort_station.operations import analysis
from local.cloud import EmbeddedCloud
from local.processes import LocalError
from testkit import machine
from testkit.command import made, parser, progress, steps, write
from testkit.waiting import InstrumentError

_S = 1_000_000
_FUNCTIONS = ("Plan", "Analyse", "Evaluate", "Present")


@dataclass(frozen=True)
class Figures:
    """What a run took: ``cpu_s`` by function. ``samples`` are all samples of all robots."""

    robot_hours: int
    samples: int
    drives: int
    findings: int
    seconds: float
    cpu_s: dict[str, float]


def main() -> None:
    """Measure, and print."""
    arguments = parser(__doc__)
    arguments.add_argument("--hours", type=_hours, default=50, help="robot-hours, each a robot's")
    given = arguments.parse_args()
    console = Console()

    try:
        with TemporaryDirectory() as folder, EmbeddedCloud(Path(folder), progress=steps(console)) as embedded:
            figures = measure(embedded, given.hours, console)
    except (InstrumentError, LocalError, StationError) as error:
        sys.exit(f"bench-analysis-cloud: {error}")
    except KeyboardInterrupt:
        sys.exit("bench-analysis-cloud: ended; nothing is kept")
    hours, cpu_s = figures.robot_hours, sum(figures.cpu_s.values())
    by_function = ", ".join(f"{name} {spent_s / hours:.2f} s" for name, spent_s in figures.cpu_s.items())
    console.print(
        f"{hours} robot-hours, {figures.samples:,} samples, analysed in {figures.seconds:.0f} s: "
        f"{figures.drives} drives, {figures.findings} findings\n"
        f"{cpu_s / hours:.2f} s of processor a robot-hour: {by_function}",
        highlight=False,
        soft_wrap=True,
    )
    write(given.json, {**made(), **asdict(figures)})


def _hours(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number from 1, got {text}")
    return int(text)


def measure(embedded: EmbeddedCloud, hours: int, console: Console) -> Figures:
    """Write the hours, and analyse them; raises `InstrumentError` if a drive is not analysed."""
    cloud = embedded.cloud
    _without_lambda_2(cloud)
    with progress(console) as bars:
        simulating = bars.add_task("hours simulated", total=1)
        spec = drive_of(0, 0, seconds=HOUR_S)
        batches, start_us = stored(spec), spec.key.start_us
        bars.advance(simulating)
        robots = [f"car{number}" for number in range(hours)]
        writing = bars.add_task("robot-hours written", total=hours)
        for robot in robots:
            _record(cloud, robot, batches)
            bars.advance(writing)
        before, began = _cpu_s(embedded), time.monotonic()
        run = analysis.start(cloud, AnalysisRequest((), start_us, start_us + round(HOUR_S) * _S, again=True))
        finding = bars.add_task("robots searched for drives", total=None)
        analysing = bars.add_task("drives analysed", total=None, start=False)
        for last in analysis.watch(cloud, run):
            if last.drives is not None:
                bars.update(finding, total=hours, completed=hours)
                bars.start_task(analysing)
                bars.update(analysing, total=last.drives, completed=last.done)
        took_s, after = time.monotonic() - began, _cpu_s(embedded)
    without = [robot for robot in robots if not findings.drives(cloud, robot)]
    if without:
        said = [one.text for one in findings.findings(cloud, without[0])]
        raise InstrumentError(f"nothing was analysed of {', '.join(without)}: {said or 'no drive was found'}")
    samples = sum(int(item[SAMPLES]["N"]) for items in batches.values() for item in items)
    return Figures(
        robot_hours=hours,
        samples=samples * hours,
        drives=last.drives or 0,
        findings=last.findings,
        seconds=round(took_s, 1),
        cpu_s={name: round(after[name] - before[name], 2) for name in _FUNCTIONS},
    )


def _record(cloud: Cloud, robot: str, batches: dict[str, list[Item]]) -> None:
    client = cloud.client("dynamodb")
    row = {ROBOT: {"S": robot}, STREAMS: {"SS": list(batches)}, "speed_to_erpm_gain": {"N": "4614"}}
    client.put_item(TableName=cloud.output("storage", "RobotsTable"), Item=row)  # type: ignore[arg-type]  # plain
    table = TelemetryTable(client, cloud.output("storage", "TelemetryTable"))
    for stream, items in batches.items():
        topic = {"S": build_topic(RECORD, robot, stream, cloud.namespace)}
        table.put({**item, TOPIC: topic} for item in items)


def _without_lambda_2(cloud: Cloud) -> None:
    client = cloud.client("lambda")
    function = cloud.output("processing", "SummarizeFunction")
    for mapping in client.list_event_source_mappings(FunctionName=function)["EventSourceMappings"]:
        client.update_event_source_mapping(UUID=mapping["UUID"], Enabled=False)


def _cpu_s(embedded: EmbeddedCloud) -> dict[str, float]:
    """The processor time of the functions' processes so far."""
    spent = dict.fromkeys(_FUNCTIONS, 0.0)
    for name, pid in _workers(embedded):
        spent[name] += machine.usage_of(pid).cpu_s
    return spent


def _workers(embedded: EmbeddedCloud) -> Iterator[tuple[str, int]]:
    for pid in machine.descendants(embedded.emulator.pid):
        # A process may end meanwhile.
        with suppress(OSError):
            command = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace")
            yield from ((name, pid) for name in _FUNCTIONS if f"-analysis-{name}" in command)


if __name__ == "__main__":
    main()
