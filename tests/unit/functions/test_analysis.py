"""The analysis, from stored batches to findings and mails, through its four functions."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import boto3
import numpy as np
import pyarrow.parquet as pq
import pytest
from botocore.exceptions import ClientError

from functions import analyse, evaluate, plan, present
from functions.shared import recordings
from functions.shared.analysis import Kept
from functions.shared.takes import MOST, Takes
from iort_analysis.archive.writing import write_hour
from iort_analysis.results import DriveResult, Mined, encode_result
from iort_analysis.samples.blocks import Block, values
from iort_contract.archive import ArchivedHour, hour_of
from iort_contract.catalog.analysis import ANALYSIS_FAILED, DRIVES_WAIT, SERIOUS
from iort_contract.catalog.derived import Vehicle
from iort_contract.cloud import PLANS_PREFIX, drive_prefix, plan_key, robots_key
from iort_contract.dynamodb import TelemetryTable
from iort_contract.findings_table import FindingsTable
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import (
    AnalysedDrive,
    AnalysisRequest,
    DriveKey,
    Estimate,
    Finding,
    PlannedDrive,
    encode_analysed,
    encode_planned,
)
from iort_contract.messages.batch import Batch
from iort_contract.messages.recorder import (
    FINDING,
    MAX_SPAN_S,
    RECORDER,
    TAKES,
    TRIGGERS,
    Trigger,
    decode_take,
    encode_trigger,
)
from iort_contract.messages.shadow import decode_desired
from iort_contract.page import PAGE_URL
from iort_contract.tables import ROBOT, STREAMS, TOPIC
from iort_contract.topics import RECORD, SHADOW, build_topic
from testkit.dynamodb import ARCHIVE, FILES, FINDINGS, ROBOTS, TELEMETRY, item_of
from tests.unit.analysis.simulated import HZ, START_US, changed, streams

S = 1_000_000
CAR, RUN = "car", "00c0ffee"
JOB = "night"


class Deployed:
    """The tables and the bucket in moto, and the state machine's calls of the functions."""

    def __init__(self, dynamodb: Any, s3: Any, topic: str) -> None:
        self.dynamodb, self.s3, self.topic = dynamodb, s3, topic
        self.table = FindingsTable(self.dynamodb, FINDINGS)

    def register(self, robot: str, *streams_of: str, **numbers: float) -> None:
        row = {ROBOT: {"S": robot}, STREAMS: {"SS": list(streams_of or ("vesc",))}}
        self.dynamodb.put_item(
            TableName=ROBOTS, Item={**row, **{name: {"N": str(value)} for name, value in numbers.items()}}
        )

    def record(
        self, blocks: dict[str, Block], *, robot: str = CAR, run: str = RUN, first_seq: int = 0
    ) -> None:
        for stream, block in blocks.items():
            seconds = (block.times_us - block.times_us[0]) // S
            batches = []
            for seq, second in enumerate(np.unique(seconds)):
                part = block.take(seconds == second)
                columns = {name: values(column) for name, column in part.columns.items()}
                batches.append(Batch(run, first_seq + seq, part.times_us.tolist(), columns))
            items = (item_of(batch, build_topic(RECORD, robot, stream)) for batch in batches)
            TelemetryTable(self.dynamodb, TELEMETRY).put(items)

    def run(self, **asked: object) -> list[dict]:
        """Run the states in order; return the planned drives."""
        request = {"robots": [], "start_us": START_US, "end_us": START_US + 3600 * S, **asked}
        run = self.plan(request)
        drives = []
        for robot in self.robots():
            for folder in (True, False):
                with suppress(self.s3.exceptions.NoSuchKey):
                    drives += self.json(plan_key(JOB, robot["robot"], drives=folder))
        for drive in drives:
            analyse.handler({"planned": drive, "job": JOB}, None)
        self.compare(run)
        return drives

    def plan(self, request: dict[str, Any]) -> dict[str, Any]:
        """Run the states Robots and Plans; return the run."""
        for folder in ("drives", "none", "waiting"):
            Kept(self.s3, FILES).remove(f"{PLANS_PREFIX}{JOB}/{folder}/")
        run = plan.handler({"input": request, "job": JOB}, None)
        for robot in self.robots():
            plan.handler({**run, **robot}, None)
        return run

    def compare(self, run: dict[str, Any]) -> list[dict[str, int]]:
        """Run the map Findings; return what Evaluate answers for each robot."""
        answers = []
        for robot in self.robots():
            answers.append(evaluate.handler({**run, **robot}, None))
            present.handler({"job": run["job"], "robot": robot["robot"]}, None)
        return answers

    def robots(self) -> list[dict[str, Any]]:
        """The items of the maps over robots."""
        return self.json(robots_key(JOB))

    def json(self, key: str) -> object:
        return json.loads(self.s3.get_object(Bucket=FILES, Key=key)["Body"].read())


@pytest.fixture
def cloud(dynamodb: Any, s3: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Deployed]:
    topic = boto3.client("sns").create_topic(Name="alarms")["TopicArn"]
    monkeypatch.setenv("ALARM_TOPIC", topic)
    monkeypatch.setenv("PAGE_URL", PAGE_URL)
    return Deployed(dynamodb, s3, topic)


def later(blocks: dict[str, Block], seconds: int) -> dict[str, Block]:
    return {name: Block(block.times_us + seconds * S, block.columns) for name, block in blocks.items()}


def test_two_drives_with_a_stand_between_them_have_two_results(cloud: Deployed) -> None:
    cloud.register(CAR, "vesc", "pose", "agent", speed_to_erpm_gain=4614, mass_kg=3.7)
    cloud.record(streams(90))
    cloud.record(later(streams(90), 300), first_seq=90)

    drives = cloud.run()

    assert [(one["start_us"], one["streams"], one["motion"]) for one in drives] == [
        (START_US, ["pose", "vesc"], "vesc"),
        (START_US + 300 * S, ["pose", "vesc"], "vesc"),
    ]
    second, first = cloud.table.drives(CAR)
    assert first.samples == second.samples == 90 * HZ * 3 // 2
    assert not {name: why for name, why in first.missing.items() if "failed" in why or "vesc" in name}
    assert first.estimates["lap_mean_s"].unit == "s"
    result = cloud.json(f"{drive_prefix(first.drive)}result.json")
    assert result["estimates"].keys() == first.estimates.keys()
    file = cloud.s3.get_object(Bucket=FILES, Key=f"{drive_prefix(first.drive)}laps.parquet")
    laps = pq.read_table(io.BytesIO(file["Body"].read())).to_pandas()
    assert laps["time_s"][laps["best"]].tolist() == pytest.approx([first.estimates["lap_best_s"].value])
    assert set(laps["method"]) == {"gate"}


def test_hours_that_have_expired_are_read_from_the_archive(cloud: Deployed) -> None:
    """One hour of a drive is in the archive alone, the next one in the table, and some batches in both."""
    hour_us = 3_600_000_000
    to_hour_s = (hour_us - START_US % hour_us) // S
    cloud.register(CAR)
    cloud.record(later({"vesc": streams(90)["vesc"]}, to_hour_s - 45))
    cloud.run(end_us=START_US + 2 * hour_us)
    (whole,) = cloud.table.drives(CAR)

    topic = build_topic(RECORD, CAR, "vesc")
    items = [one for page in TelemetryTable(cloud.dynamodb, TELEMETRY).pages(topic) for one in page.items]
    hour = hour_of(START_US)
    first = [one for one in items if int(one["batch"]["S"][:16]) < hour.end_us]
    file = io.BytesIO()
    written = write_hour(first, file, hour=hour, refused=io.BytesIO(), scratch=io.BytesIO())
    key = "archive/hour.parquet"
    row = ArchivedHour(topic, str(hour), key, len(first), written.samples, 0, "", "", 1, 1, first_expires_s=1)
    cloud.s3.put_object(Bucket=FILES, Key=row.key, Body=file.getvalue())
    cloud.dynamodb.put_item(TableName=ARCHIVE, Item=row.item())
    for one in first[:-5]:
        key = {name: one[name] for name in (TOPIC, "batch")}
        cloud.dynamodb.delete_item(TableName=TELEMETRY, Key=key)
    cloud.run(end_us=START_US + 2 * hour_us, again=True)

    (again,) = cloud.table.drives(CAR)
    assert 40 < len(first) < 50 < len(items)
    assert replace(again, analysed_us=whole.analysed_us) == whole


def test_a_range_of_all_times_has_the_drives_of_all_years(cloud: Deployed) -> None:
    """A field that came in the second minute is known, though the range goes on for decades after it."""
    drive, year_s = streams(120), 366 * 86_400
    vesc = drive["vesc"]
    without = {name: column for name, column in vesc.columns.items() if name != "speed"}
    half = len(vesc.times_us) // 2
    cloud.register(CAR)
    cloud.record({"vesc": Block(vesc.times_us, without).take(slice(half))})
    cloud.record({"vesc": vesc.take(slice(half, None))}, first_seq=60)
    cloud.record(later({"vesc": vesc}, 2 * year_s), run="00c0ffef")

    planned = cloud.run(start_us=0, end_us=START_US + 20 * year_s * S)

    assert [(one["start_us"] - START_US) // S for one in planned] == [0, 2 * year_s]
    assert {one["motion"] for one in planned} == {"vesc"}


def test_only_new_drives_are_analysed_unless_again(cloud: Deployed) -> None:
    cloud.register(CAR)
    cloud.record(streams(30))

    assert len(cloud.run()) == 1
    assert cloud.run() == []
    assert len(cloud.run(again=True)) == 1
    # A drive that has gone on since is another one up to its end.
    cloud.record(later(streams(30), 30), first_seq=30)
    assert len(cloud.run()) == 1
    assert [one.samples for one in cloud.table.drives(CAR)] == [60 * HZ]


def test_drives_of_two_runs_at_the_same_time_are_known(cloud: Deployed) -> None:
    """The run that began second ends first."""
    cloud.register(CAR)
    cloud.record({"vesc": streams(200)["vesc"]})
    cloud.record(later({"vesc": streams(30)["vesc"]}, 20), run="00c0ffef")

    assert [one["start_us"] - START_US for one in cloud.run()] == [20 * S, 0]
    assert cloud.run() == []


def test_a_drive_that_began_before_the_range_is_whole(cloud: Deployed) -> None:
    cloud.register(CAR)
    cloud.record(streams(120))

    (drive,) = cloud.run(start_us=START_US + 100 * S)

    assert drive["start_us"] == START_US


def test_no_state_of_a_recording_stops_the_others(cloud: Deployed) -> None:
    """Each robot has another trouble, and each gets a result that says what it is."""
    nulls = changed("speed", slice(None), np.nan, 20)
    jump = {"vesc": streams(60)["vesc"].take(slice(0, 20 * HZ))}
    times, text = START_US + np.arange(100) * 20_000, np.array(["a", "b"] * 50, dtype=object)
    vesc = streams(20)["vesc"]
    troubles = {
        "null": (nulls, {"vesc.speed": "null in every sample"}),
        "few": ({"vesc": vesc.take(slice(40, 42))}, {}),
        "other": (
            {"imu": Block(times, {"speed": text})},
            {"vesc": "no stream has"},
        ),
        "two": ({"front": vesc, "rear": vesc}, {"rear": "only the first is analysed, front"}),
    }
    for robot, (blocks, _) in troubles.items():
        cloud.register(robot, *blocks)
        cloud.record(blocks, robot=robot)
    cloud.register("clock")
    cloud.record(jump, robot="clock")
    cloud.record(later({"vesc": streams(60)["vesc"]}, 15), robot="clock", first_seq=20)
    cloud.register("quarantine")
    cloud.record({"vesc": vesc}, robot="quarantine")
    batch, topic = f"{START_US + 5 * S:016d}-{RUN}-5", build_topic(RECORD, "quarantine", "vesc")
    gone = {TOPIC: {"S": topic}, "batch": {"S": batch}}
    cloud.dynamodb.delete_item(TableName=TELEMETRY, Key=gone)
    cloud.register("nothing")

    cloud.run()

    assert list(cloud.table.drives("nothing")) == []
    expected = {robot: missing for robot, (_, missing) in troubles.items()} | {
        "clock": {"vesc clock": "set back by 4.0 s: 20 of 80 batches"},
        "quarantine": {"vesc batches": "1 of 20 are not stored"},
    }
    for robot, missing in expected.items():
        (analysed,) = cloud.table.drives(robot)
        for name, reason in missing.items():
            assert reason in analysed.missing[name], robot
    # The miners that had too little say so, too.
    (few,) = cloud.table.drives("few")
    assert few.missing
    assert not few.estimates


def test_a_worn_part_is_found_against_earlier_drives(cloud: Deployed) -> None:
    def resistance(day: int, value: float, job: str) -> AnalysedDrive:
        drive = DriveKey(CAR, START_US + day * 86_400 * S, RUN)
        estimates = {"battery_resistance_ohm": Estimate(value, value - 0.001, value + 0.001, "ohm")}
        return AnalysedDrive(drive, drive.start_us + 60 * S, job, 3000, estimates, {}, {})

    for day in range(-8, 0):
        cloud.table.put_drive(resistance(day, 0.03 + 0.0005 * (day % 3), "before"))
    # Analysed again after a year, a drive is still compared with those before it.
    for day in range(1, 350):
        cloud.table.put_drive(resistance(day, 0.06, "since"))
    worn = resistance(0, 0.06, JOB)
    cloud.table.put_drive(worn)
    result = DriveResult(worn.drive, worn.end_us, 3000, {}, Mined(estimates=worn.estimates))
    planned = PlannedDrive(worn.drive, worn.end_us, ("vesc",), "vesc")
    kept = Kept(cloud.s3, FILES)
    kept.put_json(plan_key(JOB, CAR), [encode_planned(planned)])
    kept.put_json(f"{drive_prefix(worn.drive)}result.json", encode_result(result))

    run = {"job": JOB, "robot": CAR, "others": [], "began_us": time.time_ns() // 1000, "again": False}
    evaluate.handler({**run, "start_us": START_US, "end_us": START_US + 1}, None)
    present.handler({"job": JOB, "robot": CAR}, None)

    (found,) = cloud.table.findings(CAR)
    assert (found.kind, found.drive) == ("battery_worn", worn.drive)
    assert found.effect
    assert found.effect.low > 0.02


def finding(text: str = "the battery drops", *, at_us: int = START_US) -> Finding:
    return Finding(
        drive=DriveKey(CAR, START_US, RUN),
        kind="cell_dropout",
        severity=SERIOUS,
        subject="cell_dropout",
        from_us=at_us,
        to_us=at_us + 20 * S,
        stream="vesc",
        fields=("voltage_input", "current_input"),
        text=text,
        effect=Estimate(1.25, 1.1, 1.4, "V"),
    )


def test_a_serious_finding_is_mailed_once_with_a_link_to_its_evidence(cloud: Deployed) -> None:
    mails: list[tuple[str, str]] = []

    def notify(subject: str, text: str) -> None:
        mails.append((subject, text))

    drive = finding().drive
    for found in ([finding()], [finding("again")], []):
        present.present([(drive, found)], cloud.table, notify, "https://page.example.org/")
        assert [one.text for one in cloud.table.findings(CAR)] == [one.text for one in found]

    ((subject, text),) = mails
    assert subject == "car: the battery's voltage drops for moments under load"
    assert "1.25 V, 90 % sure between 1.1 and 1.4" in text
    link = (
        "https://page.example.org/#/history/car?stream=vesc&from=2023-11-14T22:13:20.000Z"
        "&to=2023-11-14T22:13:40.000Z&fields=voltage_input,current_input\n"
    )
    assert link in text
    # A year of drives with one fault is one mail.
    year = [replace(finding(), drive=DriveKey(CAR, START_US + day * S, RUN)) for day in range(1, 4)]
    counts = present.present([(one.drive, [one]) for one in year], cloud.table, notify, PAGE_URL)
    assert (counts, len(mails)) == ({"findings": 3, "mails": 1}, 2)
    share = replace(finding(), effect=Estimate(0.087, 0.005, 0.17, "1"))
    assert "effect   0.087, 90 % sure" in present.mail(share, PAGE_URL)[1]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        ({"Error": "Sandbox.Timedout", "Cause": ""}, "Sandbox.Timedout"),
        ({"Error": "Lambda.Unknown", "Cause": "the worker was killed"}, "the worker was killed"),
        (
            {"Error": "E", "Cause": json.dumps({"errorType": "MemoryError", "errorMessage": "none left"})},
            "MemoryError: none left",
        ),
    ],
)
def test_a_failed_drive_is_a_finding_until_it_succeeds(
    cloud: Deployed, error: dict[str, str], reason: str
) -> None:
    cloud.register(CAR)
    cloud.record(streams(30))
    (drive,) = cloud.run()

    present.handler({"failed": drive, "error": error}, None)
    (found,) = cloud.table.findings(CAR)
    cloud.run(again=True)

    assert (found.kind, found.drive.start_us) == (ANALYSIS_FAILED, START_US)
    assert found.text == f"the drive could not be analysed in three attempts: {reason}"
    assert ANALYSIS_FAILED not in {one.kind for one in cloud.table.findings(CAR)}


def test_a_failed_plan_is_a_finding_until_its_range_is_planned(cloud: Deployed) -> None:
    cloud.register(CAR)
    failed = {"robot": CAR, "start_us": START_US, "end_us": START_US + 60 * S}
    present.handler({"failed": failed, "error": {"Cause": "no answer"}}, None)
    (found,) = cloud.table.findings(CAR)
    assert found.text == "the drives could not be found in three attempts: no answer"

    for end_us, left in ((START_US + 30 * S, [found]), (START_US + 60 * S, [])):
        cloud.run(end_us=end_us)
        assert list(cloud.table.findings(CAR)) == left


def test_a_drive_that_ends_without_an_answer_is_a_finding_too(cloud: Deployed) -> None:
    """Its workflow took too long, or could not write the finding."""
    cloud.register(CAR)
    cloud.record(streams(30))
    run = cloud.plan({"robots": [], "start_us": START_US, "end_us": START_US + S})
    cloud.table.put_finding(finding())

    cloud.compare(run)

    failed, earlier = sorted(cloud.table.findings(CAR), key=lambda one: one.kind)
    assert failed.text == "the drive could not be analysed in three attempts: they ended without an answer"
    assert earlier == finding()


def test_two_runs_at_the_same_time_both_have_the_drive(cloud: Deployed) -> None:
    """The row says which of them was the last."""
    cloud.register(CAR)
    cloud.record(streams(30))
    request = {"robots": [], "start_us": START_US, "end_us": START_US + S, "again": True}
    run = cloud.plan(request)
    (drive,) = cloud.json(plan_key(JOB, CAR))
    for job in (JOB, "the other"):
        analyse.handler({"planned": drive, "job": job}, None)

    assert cloud.compare(run) == [{"drives": 1, "findings": 0}]
    # A result from before the run is no answer of it.
    late = {**run, "job": "late", "began_us": time.time_ns() // 1000}
    plan.handler({**late, "robot": CAR}, None)
    assert evaluate.handler({**late, "robot": CAR, "others": []}, None) == {"drives": 1, "findings": 1}


def test_a_robot_that_invents_drives_has_so_many_a_night_and_loses_none(cloud: Deployed) -> None:
    """Each run of the agent is a drive, and its name is the robot's choice."""
    cloud.register(CAR)
    cloud.register("other")
    cloud.record({"vesc": streams(20)["vesc"]}, robot="other")
    for number in range(5):
        cloud.record(later({"vesc": streams(20)["vesc"]}, number * 30), run=f"{number:08x}")

    for done, left in ((2, 3), (4, 1)):
        cloud.run(most=2)
        assert len(list(cloud.table.drives(CAR))) == done
        (waits,) = [one for one in cloud.table.findings(CAR) if one.kind == DRIVES_WAIT]
        assert waits.text == f"{left} drives from here on are more than a run takes, and wait for another"
        assert waits.from_us == START_US + done * 30 * S
    assert len(list(cloud.table.drives("other"))) == 1
    # The range of a later night begins after the last of them.
    cloud.run(most=2, start_us=START_US + 3000 * S)

    assert len(list(cloud.table.drives(CAR))) == 5
    assert list(cloud.table.findings(CAR)) == []


def test_drives_that_could_not_be_compared_are_compared_in_the_next_night(cloud: Deployed) -> None:
    """They are analysed already, so they count as new once more."""
    cloud.register(CAR)
    cloud.record(streams(30))
    (drive,) = cloud.run()
    failed = {"robot": CAR, "others": [], "start_us": START_US, "end_us": START_US + 60 * S}
    present.handler({"failed": failed, "error": {"Cause": "no answer"}, "state": "Evaluate"}, None)
    (found,) = cloud.table.findings(CAR)
    assert found.text == "the drives could not be compared in three attempts: no answer"

    assert cloud.run() == [drive]
    assert list(cloud.table.findings(CAR)) == []
    assert cloud.run() == []


def test_a_robot_is_compared_with_some_of_a_large_fleet() -> None:
    fleet = [f"car{number:04}" for number in range(5000)]
    night = plan.selected(AnalysisRequest((), 0, 1), fleet)

    assert [one["robot"] for one in night] == fleet
    assert {len(set(one["others"]) - {one["robot"]}) for one in night} == {plan.OTHERS}
    assert night[-1]["others"][:2] == ["car0000", "car0001"]
    # A small fleet is compared as a whole; a robot that was removed is in none.
    small = plan.selected(AnalysisRequest(("b", "gone"), 0, 1), ["a", "b", "c"])
    assert [sorted(one["others"]) for one in small] == [["a", "c"], ["a", "b", "c"]]


def test_the_next_night_looks_for_the_drives_of_a_failed_plan(cloud: Deployed) -> None:
    """Nights overlap by a day only, so what failed may begin before the next range."""
    cloud.register(CAR)
    cloud.record(streams(30))
    failed = {"robot": CAR, "start_us": START_US - S, "end_us": START_US + 600 * S}
    present.handler({"failed": failed, "error": {"Cause": "no answer"}}, None)
    next_night = {"start_us": START_US + 300 * S, "end_us": START_US + 900 * S}

    # An operator's range stays as it is.
    assert cloud.run(**next_night, again=True) == []
    assert len(list(cloud.table.findings(CAR))) == 1
    (drive,) = cloud.run(**next_night)

    assert drive["start_us"] == START_US
    assert list(cloud.table.findings(CAR)) == []


def test_a_drive_whose_start_moves_is_one_drive(cloud: Deployed) -> None:
    """Its first half minute arrives a day later; and what had failed under the old start is done, too."""
    cloud.register(CAR, "vesc", "pose")
    cloud.record(later(streams(90), 30), first_seq=30)
    cloud.run()
    (half,) = cloud.table.drives(CAR)
    cloud.table.put_finding(replace(finding(), drive=half.drive))
    failed = {**vars(half.drive), "start_us": START_US + 20 * S, "end_us": half.end_us}
    present.handler({"failed": failed, "error": {}}, None)
    # Another run of the agent at the same time is another drive.
    cloud.record(later(streams(30), 40), run="00c0ffef")
    cloud.record(streams(30))

    cloud.run()

    other, whole = cloud.table.drives(CAR)
    assert (other.drive.run, whole.drive) == ("00c0ffef", DriveKey(CAR, START_US, RUN))
    assert {one.drive for one in cloud.table.findings(CAR)} <= {whole.drive, other.drive}
    kept = cloud.s3.list_objects_v2(Bucket=FILES, Prefix="analysis/robot=")["Contents"]
    folders = {one["Key"].rpartition("/")[0] + "/" for one in kept}
    assert folders == {drive_prefix(whole.drive), drive_prefix(other.drive)}


def test_a_field_that_comes_later_tells_of_motion(cloud: Deployed) -> None:
    """The driver published no speed at first, and another stream has one all the time."""
    drive = streams(120)["vesc"]
    without = {name: column for name, column in drive.columns.items() if name != "speed"}
    half = len(drive.times_us) // 2
    cloud.register(CAR, "vesc", "wheels")
    cloud.record({"vesc": Block(drive.times_us, without).take(slice(half))})
    cloud.record({"vesc": drive.take(slice(half, None))}, first_seq=60)
    cloud.record({"wheels": Block(drive.times_us, {"speed": drive.columns["speed"]})})

    (planned,) = cloud.run(end_us=START_US + 120 * S)

    assert planned["motion"] == "vesc"


def test_a_robot_that_records_and_never_moves_is_a_finding(cloud: Deployed) -> None:
    vesc = streams(90)["vesc"]
    # Its speed is in m/s, though its stream is a motor controller's.
    slow = Block(vesc.times_us, {**vesc.columns, "speed": vesc.columns["speed"] / 4614})
    cloud.register(CAR)
    cloud.record({"vesc": slow})
    cloud.record(later({"vesc": slow.take(slice(0, 30 * HZ))}, 300), first_seq=90)

    (planned,) = cloud.run()

    assert planned["start_us"] == START_US
    (found,) = [one for one in cloud.table.findings(CAR) if one.kind == "never_moved"]
    assert (found.severity, found.stream, found.fields) == ("info", "vesc", ("speed",))
    assert found.text.startswith("the robot recorded 90 s and never moved: vesc.speed was ")
    assert found.text.endswith(" erpm at most, and above 200 it moves")
    # As soon as a drive is recorded, it alone counts.
    cloud.record(later({"vesc": vesc}, 600), first_seq=120)
    assert [(one["start_us"] - START_US) // S for one in cloud.run()] == [600]


def test_a_robot_without_a_drive_leaves_no_file_for_the_map(cloud: Deployed) -> None:
    cloud.register(CAR)

    assert cloud.run() == []

    keys = [one["Key"] for one in cloud.s3.list_objects_v2(Bucket=FILES)["Contents"]]
    assert plan_key(JOB, CAR, drives=False) in keys
    assert plan_key(JOB, CAR) not in keys


def test_a_default_gain_that_nobody_has_touched_is_not_registered(cloud: Deployed) -> None:
    """The skateboard's log has its own speed, which tells its gain."""
    vesc = streams(120)["vesc"]
    log = {**vesc.columns, "speed_meters_per_sec": vesc.columns["speed"] / 1062}
    cloud.register("default", speed_to_erpm_gain=4614, speed_to_erpm_offset=0)
    cloud.register("own", speed_to_erpm_gain=4614, speed_to_erpm_offset=0, speed_to_erpm_gain_set_ms=1)
    cloud.register("other", speed_to_erpm_gain=1060)
    known = {robot: recordings.deployed().registered(robot).vehicle for robot in ("default", "own", "other")}
    cloud.record({"vesc": Block(vesc.times_us, log)}, robot="default")

    cloud.run(robots=["default"])

    assert known == {"default": None, "own": Vehicle(4614.0), "other": Vehicle(1060.0)}
    (drive,) = cloud.table.drives("default")
    assert drive.estimates["speed_to_erpm_gain"].value == pytest.approx(1062)


def test_the_row_of_a_drive_with_thousands_of_null_fields_fits_in_an_item() -> None:
    missing = {f"a_stream_{i // 100}.{'f' * 60}{i}": "the field is null in every sample" for i in range(5000)}
    drive = DriveKey(CAR, START_US, RUN)
    made = analyse.row(
        DriveResult(drive, START_US, 1, {}, Mined(missing={**missing, "lap_mean_s": "too short"})), JOB
    )

    assert len(json.dumps(encode_analysed(made))) < 100_000
    assert made.missing["lap_mean_s"] == "too short"
    assert made.missing["others"] == "4,801 more are in the drive's result.json"


@pytest.mark.parametrize(
    "request_", [{}, {"start_us": 2, "end_us": 2}, {"last_s": 0}, {"last_s": 60, "robots": ["a/b"]}]
)
def test_a_wrong_request_is_refused(cloud: Deployed, request_: dict) -> None:
    with pytest.raises(ContractError):
        plan.handler({"input": request_, "job": JOB}, None)


def test_the_schedule_asks_for_the_last_days(cloud: Deployed) -> None:
    cloud.register(CAR)
    found = plan.handler({"input": {"robots": [], "last_s": 86_400}, "job": JOB}, None)

    assert found["end_us"] - found["start_us"] == 86_400 * S
    assert cloud.robots() == [{"robot": CAR, "others": []}]


# --- a robot keeps what its ring has of a finding -----------------------------------------------------


def on_finding(name: str = "findings", **changes: Any) -> dict[str, Any]:
    trigger = Trigger(name, on=FINDING, before_s=5, after_s=2, **changes)
    return encode_trigger(trigger)[RECORDER][TRIGGERS]


def shadow(triggers: dict[str, Any], takes: dict[str, Any] | None = None) -> dict[str, Any]:
    """A shadow as AWS answers it, without the nulls of a change."""
    compact = {name: {k: v for k, v in one.items() if v is not None} for name, one in triggers.items()}
    return {"state": {"desired": {RECORDER: {TRIGGERS: compact, TAKES: takes or {}}}}, "version": 7}


class Shadows:
    """AWS IoT's shadows of robots."""

    class exceptions:
        class ResourceNotFoundException(Exception):
            pass

    def __init__(self, **documents: Any) -> None:
        self.documents, self.written = documents, []

    def get_thing_shadow(self, *, thingName: str, shadowName: str) -> dict[str, Any]:
        assert shadowName == SHADOW
        if thingName not in self.documents:
            raise self.exceptions.ResourceNotFoundException
        document = self.documents[thingName]
        if isinstance(document, Exception):
            raise document
        return {"payload": io.BytesIO(json.dumps(document).encode())}

    def update_thing_shadow(self, *, thingName: str, shadowName: str, payload: str) -> None:
        assert (thingName in self.documents, shadowName) == (True, SHADOW)
        self.written.append(
            (thingName, decode_desired(json.loads(payload)["state"]["desired"]).recorder.takes)
        )


def test_a_robot_with_a_trigger_on_findings_keeps_the_time_of_a_new_one(cloud: Deployed, capsys) -> None:
    shadows = Shadows(car=shadow(on_finding(topics=("/camera/*",))))
    for _ in range(2):
        present.present(
            [(finding().drive, [finding()])], cloud.table, lambda *_: None, PAGE_URL, Takes(shadows).ask
        )
    ((robot, takes),) = shadows.written
    ((name, content),) = takes.items()
    content = {key: value for key, value in content.items() if value is not None}
    taken = decode_take(name, content)
    assert (robot, taken.by, taken.why) == (CAR, "analysis", "cell_dropout: the battery drops")
    assert (taken.from_us, taken.to_us) == (START_US - 5 * S, START_US + 22 * S)
    assert taken.topics == ("/camera/*",)
    assert '"FindingTakes":1' in capsys.readouterr().out


@pytest.mark.parametrize(
    "document",
    [
        {},
        shadow({}),
        shadow(on_finding(notify=True)),
        shadow(encode_trigger(Trigger("stops", on="stop"))[RECORDER][TRIGGERS]),
        shadow({"broken": {"on": FINDING, "before_s": -5}}),
        {"state": {"desired": {RECORDER: 5}}},
        ClientError({"Error": {"Code": "ThrottlingException"}}, "GetThingShadow"),
    ],
)
def test_other_robots_get_no_take_and_no_finding_fails(document: Any) -> None:
    shadows = Shadows(car=document)
    assert Takes(shadows).ask(CAR, [finding()]) == Takes(shadows).ask("none", [finding()]) == 0
    assert shadows.written == []


def test_a_run_asks_for_few_takes_and_an_operators_stay() -> None:
    now_us = time.time_ns() // 1000
    own = {"0" * 16: {"from_us": now_us - S, "to_us": now_us, "by": "lab"}}
    earlier = {
        f"{n:016x}": {"from_us": START_US, "to_us": START_US + n * S, "by": "analysis"} for n in (1, 2)
    }
    shadows = Shadows(car=shadow({**on_finding(), **on_finding("more")}, {**own, **earlier}))
    drives = [replace(finding(at_us=START_US + n * 60 * S), severity="notice") for n in range(5)]
    serious = finding(at_us=START_US - 60 * S)
    failed = replace(finding(), kind=ANALYSIS_FAILED)
    assert Takes(shadows).ask(CAR, [failed, *drives, serious]) == MOST == 3
    ((_, takes),) = shadows.written
    assert [name for name, one in takes.items() if one is None] == list(earlier)
    assert own.keys().isdisjoint(takes)
    begins = [one["from_us"] + 5 * S for one in takes.values() if one is not None]
    assert begins == [one.from_us for one in (serious, drives[4], drives[3])]
    # Where the operator's fill the shadow, there is no room for others.
    full = {f"{n:016x}": {"from_us": now_us - S, "to_us": now_us, "by": "lab"} for n in range(4)}
    assert Takes(Shadows(car=shadow(on_finding(), full))).ask(CAR, drives) == 0


def test_of_a_long_finding_the_end_is_taken() -> None:
    hour = replace(finding(), to_us=START_US + 3600 * S)
    shadows = Shadows(car=shadow({**on_finding(), **on_finding("all", topics=("vesc",))}))
    assert Takes(shadows).ask(CAR, [hour]) == 1
    ((_, takes),) = shadows.written
    (content,) = takes.values()
    assert content["to_us"] == START_US + 3602 * S
    assert content["to_us"] - content["from_us"] == MAX_SPAN_S * S
    assert content.get("topics") is None, "one trigger wants all topics"


def test_findings_take_no_room_that_the_shadow_does_not_have() -> None:
    full = on_finding(topics=tuple(f"/{i}{'t' * 120}" for i in range(4)))
    full |= on_finding("other", topics=tuple(f"/{i}{'u' * 120}" for i in range(4)))
    some = [finding(at_us=START_US + i * 60 * S) for i in range(3)]
    shadows = Shadows(car=shadow(full))
    assert Takes(shadows).ask(CAR, some) == 2
    ((_, takes),) = shadows.written
    assert len(takes) == 2
