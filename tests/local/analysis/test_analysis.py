"""The analysis as deployed: drives of the simulated car through the state machine, whatever happens to its
functions."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from typing_extensions import Self

from iort_analysis.samples.blocks import Block, values
from iort_contract.catalog.analysis import ANALYSIS_FAILED
from iort_contract.dynamodb import TelemetryTable
from iort_contract.messages.batch import Batch
from iort_contract.tables import ROBOT, STREAMS
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.data import findings
from iort_station.operations import analysis
from local.cloud import EmbeddedCloud
from testkit.dynamodb import item_of
from testkit.waiting import until
from tests.local.conftest import fire, run_agent
from tests.unit.analysis.simulated import streams

pytestmark = pytest.mark.slow
S = 1_000_000


def stored(embedded, robot: str, blocks: dict[str, Block], *, run: str = "00c0ffee") -> None:
    """Write batches of a second, as the record rule does."""
    client = embedded.cloud.client("dynamodb")
    client.update_item(
        TableName=embedded.cloud.output("storage", "RobotsTable"),
        Key={ROBOT: {"S": robot}},
        UpdateExpression="ADD #streams :streams",
        ExpressionAttributeNames={"#streams": STREAMS},
        ExpressionAttributeValues={":streams": {"SS": list(blocks)}},
    )
    items = []
    for stream, block in blocks.items():
        seconds = (block.times_us - block.times_us[0]) // S
        for seq, second in enumerate(np.unique(seconds)):
            part = block.take(seconds == second)
            columns = {name: values(column) for name, column in part.columns.items()}
            items.append(
                item_of(Batch(run, seq, part.times_us.tolist(), columns), build_topic(RECORD, robot, stream))
            )
    TelemetryTable(client, embedded.cloud.output("storage", "TelemetryTable")).put(items)


def ago(seconds: int, blocks: dict[str, Block]) -> dict[str, Block]:
    """The streams as if they had been recorded so long ago."""
    first_us = min(int(block.times_us[0]) for block in blocks.values())
    by_us = time.time_ns() // 1000 // S * S - seconds * S - first_us
    return {name: Block(block.times_us + by_us, block.columns) for name, block in blocks.items()}


def test_the_nightly_schedule_analyses_the_fleet(embedded, bundle) -> None:
    cloud, car = embedded.cloud, bundle().robot
    drive = ago(1000, streams(60))
    stored(embedded, car, drive)
    client, machine = cloud.client("stepfunctions"), cloud.output("analysis", "AnalysisMachine")

    def runs() -> set[str]:
        return {one["executionArn"] for one in client.list_executions(stateMachineArn=machine)["executions"]}

    before = runs()
    fire(embedded, "analysis-Nightly")
    (run,) = until(lambda: runs() - before)

    assert json.loads(client.describe_execution(executionArn=run)["input"]) == {
        "robots": [],
        "last_s": 2 * 86_400,
        "most": 100,
    }
    # It raises an error if the run fails.
    *_, last = analysis.watch(cloud, run)
    assert last.state == analysis.SUCCEEDED
    (analysed,) = findings.drives(cloud, car)
    assert analysed.job == run.rpartition(":")[2]
    assert analysed.samples == sum(len(block.times_us) for block in drive.values())


def test_a_night_without_drives_passes_the_map_by(embedded, bundle, iort) -> None:
    car, client = bundle().robot, embedded.cloud.client("stepfunctions")

    done = iort("analyse", car, "--last", "1h", "--wait", "--json")

    assert done.exit_code == 0, done.output
    answer = json.loads(done.stdout)
    assert (answer["drives"], answer["failed"]) == (0, 0)
    machine = embedded.cloud.output("analysis", "AnalysisMachine")
    run = f"{machine.replace(':stateMachine:', ':execution:')}:{answer['run']}"
    pages = client.get_paginator("get_execution_history").paginate(executionArn=run)
    details = [one.get("stateEnteredEventDetails") for page in pages for one in page["events"]]
    entered = [one["name"] for one in details if one]
    assert entered.index("AnyDrives") < entered.index("Findings")
    assert "Drives" not in entered


@pytest.mark.heavy
def test_two_drives_of_the_agent_are_analysed(embedded, bundle, iort) -> None:
    """The agent's car drives twice; between the runs it is off."""
    car = bundle(sources=[{"type": "sim", "duration_s": 20, "rate_hz": 50}])
    for _ in range(2):
        run_agent(car)
    until(lambda: len(data.query(embedded.cloud, car.robot, "vesc", "-1h", "now")) == 2 * 1000)
    until(lambda: {"vesc", "pose"} <= set(_row_streams(embedded, car.robot)))

    done = iort("analyse", car.robot, "--last", "1h", "--wait", "--json")

    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["drives"] == 2
    drives = findings.drives(embedded.cloud, car.robot)
    assert [one.samples for one in drives] == [1400, 1400]
    # They are short, and every miner says what it needs.
    assert all("lap_mean_s" in {**one.estimates, **one.missing} for one in drives)
    assert not [why for one in drives for why in one.missing.values() if "failed" in why]
    listed = iort("findings", car.robot, "--drives", "--json")
    assert [one["samples"] for one in json.loads(listed.stdout)] == [1400, 1400]


def _row_streams(embedded, robot: str) -> list[str]:
    table = embedded.cloud.output("storage", "RobotsTable")
    row = embedded.cloud.client("dynamodb").get_item(TableName=table, Key={ROBOT: {"S": robot}})["Item"]
    return row.get(STREAMS, {"SS": []})["SS"]


def long() -> dict[str, Block]:
    """The car's ten minutes, five times: their analysis takes two seconds."""
    return {
        name: Block(
            np.concatenate([block.times_us + i * 600 * S for i in range(5)]),
            {field: np.tile(column, 5) for field, column in block.columns.items()},
        )
        for name, block in streams(600).items()
    }


class Killer(threading.Thread):
    """Kills workers of the function Analyse in the middle of their work, so many times."""

    def __init__(self, embedded: EmbeddedCloud, times: int) -> None:
        super().__init__()
        self.left, self._over, self._embedded = times, threading.Event(), embedded
        self._before = _analysing(embedded)

    def run(self) -> None:
        while self.left and not self._over.wait(0.02):
            for process, used_s in _analysing(self._embedded).items():
                # Its imports take half a second of the processor.
                if self.left and used_s - self._before.get(process, 0.0) > 1.1:
                    os.kill(process, signal.SIGKILL)
                    # It is seen until it has had the processor once more to die.
                    self._before[process] = math.inf
                    self.left -= 1

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._over.set()
        self.join()


def _analysing(embedded: EmbeddedCloud) -> dict[int, float]:
    """The processor time of each of the function's workers in this cloud, in seconds."""
    found = {}
    for status in Path("/proc").glob("[0-9]*"):
        # A process may end meanwhile.
        with suppress(OSError):
            command = (status / "cmdline").read_text()
            if str(embedded.folder) in command and "iort-analysis-Analyse" in command:
                fields = (status / "stat").read_text().rpartition(")")[2].split()
                found[int(status.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


@pytest.mark.heavy
def test_a_killed_function_is_tried_again_and_three_times_are_a_finding(embedded, bundle, iort) -> None:
    good, bad = bundle("good").robot, bundle("bad").robot
    stored(embedded, good, ago(4000, long()))

    with Killer(embedded, times=3) as killer:
        done = iort("analyse", good, "--last", "2h", "--wait", "--json")

    assert killer.left == 0
    assert done.exit_code == 1, done.output
    assert json.loads(done.stdout)["failed"] == 1
    (found,) = findings.findings(embedded.cloud, good)
    assert found.kind == ANALYSIS_FAILED
    assert "in three attempts" in found.text
    assert "to do" in iort("findings", good).stdout

    # The next run has it, although it is killed once; nor does a field that is null stop it.
    null = dict(streams(60)["vesc"].columns, current_motor=np.full(3000, np.nan))
    stored(embedded, bad, ago(1000, {"vesc": Block(streams(60)["vesc"].times_us, null)}))
    with Killer(embedded, times=1) as killer:
        done = iort("analyse", good, bad, "--last", "2h", "--wait", "--new", "--json")

    assert killer.left == 0
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["drives"] == 2
    (one,) = findings.drives(embedded.cloud, good)
    assert one.samples == 225_000
    (other,) = findings.drives(embedded.cloud, bad)
    assert other.missing["vesc.current_motor"] == "the field is null in every sample"
    assert ANALYSIS_FAILED not in {one.kind for one in findings.findings(embedded.cloud, good)}
