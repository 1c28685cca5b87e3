"""Monitoring on the embedded cloud: a car's fault reaches a human, and the dashboards have data."""

from __future__ import annotations

import json
import time

import pytest

from iort_contract.catalog.metrics import METRIC_DEPLOYMENT, METRIC_FUNCTION, METRIC_NAMESPACE, METRICS
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.live import LiveSample, encode_live
from iort_contract.topics import FILE, LIVE, PING, build_topic, record_topic
from iort_station.operations import cloudwatch
from local import deployment
from testkit.mqtt import Robot
from testkit.waiting import until
from tests.local.data.drives import Agent

FAULT, LOW_V = 5, 9.5


def test_a_fault_reaches_a_human_and_the_dashboards(embedded, bundle, inbox, iort):
    cloud, bundle = embedded.cloud, bundle()
    now_us = time.time_ns() // 1000
    sample = {"fault_code": FAULT, "voltage_input": LOW_V, "temperature_pcb": 40.0}
    with Robot(bundle.folder) as robot:
        robot.online()
        live = build_topic(LIVE, robot.name, "vesc")
        for seq in range(5):
            message = encode_live(LiveSample("0" * 8, seq, now_us + seq, now_us + seq, sample))
            assert robot.publish(live, message) == "SUCCESS"
        columns = {name: [value] * 10 for name, value in sample.items()}
        drive = Batch("0" * 8, 0, [now_us + 20_000 * i for i in range(10)], columns)
        assert robot.publish(record_topic(robot.name, "vesc"), encode_batch(drive)) == "SUCCESS"

        # The rule sends robot, code and time once per cause, although five messages had it.
        def mails():
            return [mail for mail in inbox() if robot.name in mail["Message"]]

        until(lambda: len(mails()) >= 2)
        told = {mail["Message"].splitlines()[0]: mail for mail in mails()}
        assert told.keys() == {
            f"{robot.name}: fault 5, MOSFET over-temperature",
            f"{robot.name}: battery at 9.5 V, below 10.5 V",
        }
        assert all(" UTC" in mail["Message"] for mail in told.values())

    # The record lane sends the metric and the alarm.
    def alarmed():
        return [
            m for m in inbox() if m.get("Subject", "").startswith("ALARM") and "FaultSamples" in m["Message"]
        ]

    until(alarmed)
    assert len(mails()) == 2
    (alarm,) = cloud.client("cloudwatch").describe_alarms(AlarmNames=["iort-FaultSamples"])["MetricAlarms"]
    assert alarm["StateValue"] == "ALARM"
    # The command says which car it was, until somebody has seen it.
    (told,) = (one for one in json.loads(iort("alarms", "--json").stdout) if one["key"] == "FaultSamples")
    assert (told["robots"], told["acknowledged"]) == ([bundle.robot], None)
    iort("alarms", "--acknowledge", "FaultSamples", "--by", "ada")
    shown = iort("alarms").stdout
    assert f"cars: {bundle.robot}\n    acknowledged by ada at " in shown

    def lines():
        return {
            line["label"]: line["values"]
            for name in cloudwatch.dashboards(cloud)
            for widget in cloudwatch.dashboard(cloud, name, minutes=30)["widgets"]
            for line in widget["series"]
            if line["values"]
        }

    # Not the emulator's own metrics, nor widgets that stay empty in a healthy run.
    wanted = {"FaultSamples", "BatteryVolts", "record", "fault", "battery"}
    wanted |= {"Connect.Success", "PublishIn.Success", "Summarize"}
    drawn = until(lambda: wanted <= (found := lines()).keys() and found)
    assert max(drawn["FaultSamples"]) >= 10
    assert min(drawn["BatteryVolts"]) == LOW_V


def test_the_platform_dashboard_shows_warnings_of_functions(embedded, bundle):
    bundle, name = bundle(), f"{embedded.namespace}-platform"
    with Robot(bundle.folder) as robot:
        robot.publish(build_topic(PING, robot.name, FILE), b"[]")
    widgets = cloudwatch.dashboard(embedded.cloud, name, minutes=30)["widgets"]
    (number,) = [widget["number"] for widget in widgets if widget["kind"] == "log"]

    def told():
        found = cloudwatch.rows(embedded.cloud, name, number, minutes=30, now_s=time.time() + 1)
        return [dict(zip(found["columns"], row, strict=True)) for row in found["rows"]]

    line = until(lambda: next((row for row in told() if robot.name in row["@message"]), None))
    assert line["@message"].startswith("[WARNING]")
    assert "refused a message" in line["@message"]
    assert "Upload" in line["@log"]


# Runs after the first test, which awaits the moment when the alarm goes off.
@pytest.mark.parametrize(
    ("drive", "told"),
    [
        (lambda i: ("nan", FAULT if i >= 25 else 0), "fault 5, MOSFET over-temperature"),
        (lambda _: (LOW_V, "nan"), "battery at 9.5 V, below 10.5 V"),
    ],
    ids=["fault, voltage unknown", "voltage low, fault unknown"],
)
def test_an_alert_fires_when_another_field_is_null(bundle, inbox, tmp_path, drive, told):
    """The real agent sends most of its live messages where no alert can hear them."""
    log = tmp_path / "drive.csv"
    # Ten minutes: on a busy machine it takes seconds to connect.
    rows = (";".join(str(value) for value in (1000 + 20 * i, *drive(i))) for i in range(30_000))
    log.write_text("\n".join(["ms_today;input_voltage;fault_code", *rows]) + "\n")
    car = bundle(sources=[{"type": "bag", "path": str(log)}])

    def lines():
        return [line for mail in inbox() if (line := mail["Message"].splitlines()[0]).startswith(car.robot)]

    with Agent(car):
        assert until(lines) == [f"{car.robot}: {told}"]


def test_the_first_calls_of_a_cloud_count_as_no_refusal_and_warn_of_nothing(embedded):
    cloud, began_ms = embedded.cloud, time.time_ns() // 1_000_000
    client, logs = cloud.client("cloudwatch"), cloud.client("logs")

    def counted(name):
        of = {METRIC_DEPLOYMENT: cloud.namespace, METRIC_FUNCTION: METRICS[name].function}
        points = client.get_metric_statistics(
            Namespace=METRIC_NAMESPACE,
            MetricName=name,
            Dimensions=[{"Name": key, "Value": value} for key, value in of.items()],
            StartTime=began_ms / 1000 - 3600,
            EndTime=began_ms / 1000 + 3600,
            Period=3600,
            Statistics=["Sum"],
        )
        return sum(point["Sum"] for point in points["Datapoints"])

    refusals = [name for name in METRICS if name.endswith("Refused")]
    asked, before = counted("FilesAsked"), [counted(name) for name in refusals]
    deployment.warm_up(cloud, embedded.live)
    until(lambda: counted("FilesAsked") == asked + 1)
    assert [counted(name) for name in refusals] == before
    warned = [
        event["message"]
        for group in logs.describe_log_groups()["logGroups"]
        for event in logs.filter_log_events(
            logGroupName=group["logGroupName"], startTime=began_ms, filterPattern="WARNING"
        )["events"]
    ]
    assert warned == []
