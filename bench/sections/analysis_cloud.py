"""Robot-hours through the deployed analysis, on an embedded cloud.

Every robot has an hour of a simulated car, its motor controller at 50 Hz and its poses. The batches are
written to the telemetry table, and the state machine analyses them as at night. Lambda 2, which would
summarise them all, is switched off. The processor time is that of the functions' processes, with their
imports.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.proof.fleet import drive_of, stored
from bench.proof.report import HOUR_S
from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_contract.dynamodb import Item, TelemetryTable
from iort_contract.messages.analysis import AnalysisRequest
from iort_contract.tables import ROBOT, SAMPLES, STREAMS, TOPIC
from iort_contract.topics import RECORD, build_topic
from iort_station.cloud import Cloud
from iort_station.data import findings
from iort_station.operations import analysis
from local.cloud import EmbeddedCloud
from testkit import machine
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

_S = 1_000_000
_FUNCTIONS = ("Plan", "Analyse", "Evaluate", "Present")


def run(target: Target, say: Say, *, hours: int) -> Section:
    """Write the hours, analyse them, and count; raises `InstrumentError` if a drive is not analysed."""
    if target.embedded is None or hours < 1:
        raise InstrumentError("one robot-hour or more is analysed on the embedded cloud")
    figures = measure(target.embedded, hours, say)
    cpu_s = sum(figures["cpu_s"].values())
    section = Section("analysis-cloud", "Robot-hours through the deployed analysis")
    section.table(
        f"{hours} robot-hours, {figures['samples']:,} samples, analysed in {figures['seconds']:.0f} s: "
        f"{figures['drives']} drives, {figures['findings']} findings",
        ["function", "processor a robot-hour"],
        [[name, f"{spent_s / hours:.2f} s"] for name, spent_s in {**figures["cpu_s"], "all": cpu_s}.items()],
    )
    section.raw = figures
    return section


def measure(embedded: EmbeddedCloud, hours: int, say: Say) -> dict[str, Any]:
    """Write the hours, and analyse them; raises `InstrumentError` if a drive is not analysed."""
    cloud = embedded.cloud
    _without_lambda_2(cloud)
    say("simulating an hour")
    spec = drive_of(0, 0, seconds=HOUR_S)
    batches, start_us = stored(spec), spec.key.start_us
    robots = [f"car{number}" for number in range(hours)]
    for number, robot in enumerate(robots, 1):
        _record(cloud, robot, batches)
        say(f"{number} of {hours} robot-hours written")
    before, began = _cpu_s(embedded), time.monotonic()
    request = AnalysisRequest(tuple(robots), start_us, start_us + round(HOUR_S) * _S, again=True)
    for last in analysis.watch(cloud, analysis.start(cloud, request)):
        if last.drives is not None:
            say(f"{last.done} of {last.drives} drives analysed")
    took_s, after = time.monotonic() - began, _cpu_s(embedded)
    without = [robot for robot in robots if not findings.drives(cloud, robot)]
    if without:
        said = [one.text for one in findings.findings(cloud, without[0])]
        raise InstrumentError(f"nothing was analysed of {', '.join(without)}: {said or 'no drive was found'}")
    samples = sum(int(item[SAMPLES]["N"]) for items in batches.values() for item in items)
    return {
        "robot_hours": hours,
        "samples": samples * hours,
        "drives": last.drives or 0,
        "findings": last.findings,
        "seconds": round(took_s, 1),
        "cpu_s": {name: round(after[name] - before[name], 2) for name in _FUNCTIONS},
    }


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


SECTION = Declared(
    "robot-hours through the deployed analysis",
    run,
    (Option("HOURS", int, 50, "robot-hours, each a robot's"),),
    Report("analysis-cloud", "Robot-hours through the deployed analysis", "make bench ONLY=analysis-cloud"),
)
