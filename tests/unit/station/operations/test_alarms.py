"""Alarms with their entry in the catalogue, and who has seen them."""

from __future__ import annotations

import time
from decimal import Decimal

import boto3
import pytest

from iort_contract.catalog.metrics import METRICS
from iort_station.errors import StationError
from iort_station.operations import alarms
from testkit.dynamodb import ROBOTS, serialize
from tests.unit.station.data.test_queries import FakeCloud, cloud_of


class Watched(FakeCloud):
    """The fake cloud with moto's CloudWatch."""

    def client(self, service):
        return boto3.client(service) if service == "cloudwatch" else super().client(service)


@pytest.fixture
def cloud(aws):
    cloud = Watched(cloud_of(robot="car").table)
    for name in (
        "iort-FaultSamples",
        "iort-TemperatureDegC",
        "iort-LiveErrors",
        "iort-2-LiveErrors",
        "iort-x",
    ):
        put(cloud, name)
    return cloud


def put(cloud, name):
    cloud.client("cloudwatch").put_metric_alarm(
        AlarmName=name,
        Namespace="iort",
        MetricName="m",
        Period=60,
        Statistic="Sum",
        EvaluationPeriods=1,
        ComparisonOperator="GreaterThanThreshold",
        Threshold=80,
    )


def put_state(cloud, name, state):
    cloud.client("cloudwatch").set_alarm_state(AlarmName=name, StateValue=state, StateReason="a test")


def raised(cloud):
    return {alarm["key"]: alarm for alarm in alarms.alarms(cloud) if alarm["state"] == "ALARM"}


def test_an_alarm_has_the_catalogues_meaning_and_the_raised_come_first(cloud):
    put_state(cloud, "iort-FaultSamples", "INSUFFICIENT_DATA")
    put_state(cloud, "iort-TemperatureDegC", "ALARM")
    found = alarms.alarms(cloud)
    # Neither another deployment's alarm nor one that is not in the catalogue.
    assert [alarm["key"] for alarm in found] == ["TemperatureDegC", "FaultSamples", "LiveErrors"]
    entry = METRICS["TemperatureDegC"].alarm
    assert (found[0]["meaning"], found[0]["advice"], found[0]["threshold"]) == (
        entry.meaning,
        entry.action,
        80,
    )
    assert found[0]["since_s"] == pytest.approx(time.time(), abs=60)
    assert found[2]["meaning"] == "the function failed"


def test_an_acknowledgement_ends_with_the_alarm(cloud):
    put_state(cloud, "iort-FaultSamples", "ALARM")
    since_s = raised(cloud)["FaultSamples"]["since_s"]
    assert raised(cloud)["FaultSamples"]["acknowledged"] is None
    seen = alarms.acknowledge(cloud, "FaultSamples", since_s, " Ada L. <ada@lab> ")
    assert seen["by"] == "Ada L. _ada@lab_"
    found = raised(cloud)["FaultSamples"]["acknowledged"]
    assert found == {"by": seen["by"], "at_s": pytest.approx(seen["at_s"], abs=0.001)}
    put_state(cloud, "iort-FaultSamples", "OK")
    with pytest.raises(StationError, match="changed meanwhile"):
        alarms.acknowledge(cloud, "FaultSamples", since_s)
    put_state(cloud, "iort-FaultSamples", "ALARM")
    assert raised(cloud)["FaultSamples"]["acknowledged"] is None
    with pytest.raises(StationError, match="'Nothing' does not exist"):
        alarms.acknowledge(cloud, "Nothing", since_s)
    with pytest.raises(StationError, match="'2-LiveErrors' does not exist"):
        alarms.acknowledge(cloud, "2-LiveErrors", since_s)


def test_an_alarm_names_the_cars_that_an_alert_named(cloud):
    now_ms = Decimal(round(time.time() * 1000))
    online = {"online": True, "connected_ms": now_ms - 60_000}
    rows = [
        {"robot": "on", **online},
        {"robot": "faulty", **online, "alert_fault_5": now_ms // 1000 - 90},
        {"robot": "mended", **online, "alert_fault_5": now_ms // 1000 - 9000},
        {"robot": "off", "online": False, "disconnected_ms": now_ms - 9_000_000},
    ]
    for row in rows:
        cloud.table.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
    for name in ("iort-FaultSamples", "iort-TemperatureDegC", "iort-LiveErrors"):
        put_state(cloud, name, "ALARM")
    found = {key: (alarm["robots"], alarm["named"]) for key, alarm in raised(cloud).items()}
    assert found == {
        "FaultSamples": (["faulty"], True),
        "TemperatureDegC": (["faulty", "mended", "on"], False),
        "LiveErrors": ([], False),
    }
