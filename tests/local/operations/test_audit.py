"""`iort audit` on the embedded cloud: it reports missing batches and their cause."""

from __future__ import annotations

import json

import pytest

from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import Batch, batch_id, encode_batch
from iort_contract.tables import BATCH, TOPIC
from iort_contract.topics import RECORD, build_topic, record_topic
from iort_station.operations import audit
from testkit.mqtt import Robot
from testkit.waiting import until
from tests.local.conftest import run_agent

T0_US = 1_760_000_000_000_000


def _delete(embedded, robot, stream, item):
    embedded.cloud.client("dynamodb").delete_item(
        TableName=embedded.cloud.output("storage", "TelemetryTable"),
        Key={
            TOPIC: {"S": build_topic(RECORD, robot, stream, embedded.namespace)},
            BATCH: {"S": item[BATCH]},
        },
    )


def test_the_audit_confirms_a_drive_and_finds_a_lost_batch_of_any_stream(embedded, bundle, iort):
    car = bundle(
        sources=[{"type": "sim", "stream": "wheels", "rate_hz": 100, "duration_s": 2}],
        record={"batch_s": 0.25},
        live={"enabled": False},
    )
    run_agent(car)
    done = iort("audit", car.robot, "--json")
    assert done.exit_code == 0, done.output
    streams = {one["stream"]: one for one in json.loads(done.stdout)["streams"]}
    assert {"wheels", ACCOUNT_STREAM} <= streams.keys()
    assert all(one["complete"] for one in streams.values())
    wheels = streams["wheels"]
    assert (wheels["taken"], sum(run["samples"] for run in wheels["runs"])) == (200, 200)
    told = json.loads(iort("audit", "--all", "--json").stdout)["robots"][car.robot]["streams"]
    assert {one["stream"]: one["complete"] for one in told} == dict.fromkeys(streams, True)
    assert iort("audit", "--json").exit_code == iort("audit", car.robot, "--all", "--json").exit_code != 0
    found = list(audit.headers(embedded.cloud, car.robot, "wheels"))
    assert all("samples" not in item for item in found)
    seq = batch_id(found[3][BATCH]).seq
    samples = int(found[3]["n"])
    _delete(embedded, car.robot, "wheels", found[3])
    done = iort("audit", car.robot, "--json")
    assert done.exit_code == 1
    (wheels,) = [one for one in json.loads(done.stdout)["streams"] if one["stream"] == "wheels"]
    (gap,) = wheels["runs"][0]["missing"]
    assert gap["first"] == gap["last"] == seq
    # `iort runs` and `iort streams` find the same run from a few batches.
    (run,) = json.loads(iort("runs", car.robot, "--json").stdout)["runs"]
    assert run["state"] == "ended"
    # A busy machine takes the first or the last ones late.
    times_us = [
        t_us
        for stream in ("wheels", "pose")
        for batch in audit.batches(embedded.cloud, car.robot, stream)
        for t_us in batch.times_us
    ]
    assert run["seconds"] == pytest.approx((max(times_us) - min(times_us)) / 1e6, abs=0.001)
    assert run["streams"]["wheels"]["samples"] == 200
    listed = {
        one["stream"]: one for one in json.loads(iort("streams", car.robot, "--json").stdout)["streams"]
    }
    assert (listed["wheels"]["runs"], listed["wheels"]["from"]) == (1, run["from"])
    assert {"name": "speed", "unit": "erpm"} in listed["wheels"]["fields"]
    assert ACCOUNT_STREAM in listed
    (short,) = wheels["shortfalls"]
    assert short["samples"] == samples
    # No later number reveals the loss of the last batch; the agent's own count does.
    for item in audit.headers(embedded.cloud, car.robot, "wheels"):
        _delete(embedded, car.robot, "wheels", item)
    (wheels,) = [
        one
        for one in json.loads(iort("audit", car.robot, "--json").stdout)["streams"]
        if one["stream"] == "wheels"
    ]
    assert (wheels["runs"], wheels["complete"]) == ([], False)
    assert [short["samples"] for short in wheels["shortfalls"]] == [200]
    assert iort("audit", "nobody-like-that", "--json").exit_code == 1


def test_each_run_names_the_run_before_it(embedded, bundle, iort):
    """After a restart with a queue file, the next run's first batch reveals the lost end of a run."""
    car = bundle(
        queue={"path": "spool.db"},
        sources=[{"type": "sim", "stream": "wheels", "rate_hz": 100, "duration_s": 2}],
        record={"batch_s": 0.25},
        live={"enabled": False},
    )
    run_agent(car)
    run_agent(car)
    assert iort("audit", car.robot, "--from-start", "--json").exit_code == 0
    found = list(audit.headers(embedded.cloud, car.robot, "wheels"))
    first = min(batch_id(item[BATCH]) for item in found).boot
    last = max(batch_id(item[BATCH]) for item in found if batch_id(item[BATCH]).boot == first)
    _delete(embedded, car.robot, "wheels", {BATCH: str(last)})
    (wheels,) = json.loads(iort("audit", car.robot, "--stream", "wheels", "--last", "1h", "--json").stdout)[
        "streams"
    ]
    (gap,) = wheels["runs"][0]["missing"]
    assert (gap["first"], gap["last"], gap["before_us"]) == (last.seq, last.seq, None)
    assert not wheels["runs"][1]["missing"]


def test_the_audit_reports_unrecorded_samples_by_cause(embedded, bundle, iort):
    car = bundle()
    boot = "0badcafe0badcafe"
    told = [
        StreamAccount("scan", 10, 9, 1, 0, 0, 1, ended=True).sample(),
        StreamAccount("quiet", 0, 0, 0, 0, 0, 0, ended=True).sample(),
    ]
    causes = SourceAccount("ROS 1 topics /scan", {"/scan.malformed": 3, "/scan.latched_again": 2}).sample()
    with Robot(car.folder) as robot:
        robot.online()
        for seq, samples in enumerate((told, [causes])):
            columns = {name: [sample[name] for sample in samples] for name in samples[0]}
            batch = Batch(boot, seq, [T0_US] * len(samples), columns)
            assert robot.publish(record_topic(car.robot, ACCOUNT_STREAM), encode_batch(batch)) == "SUCCESS"
        scan = Batch(boot, 0, [T0_US + i for i in range(9)], {"i": list(range(9))})
        assert robot.publish(record_topic(car.robot, "scan"), encode_batch(scan)) == "SUCCESS"
    until(lambda: list(audit.headers(embedded.cloud, car.robot, "scan")))
    done = iort("audit", car.robot, "--json")
    assert done.exit_code == 1
    answer = json.loads(done.stdout)
    streams = {one["stream"]: one for one in answer["streams"]}
    assert streams["quiet"]["complete"]
    assert [(s["samples"], s["cause"]) for s in streams["scan"]["shortfalls"]] == [
        (1, "refused by the agent: no message can hold them")
    ]
    assert answer["not_recorded"] == {boot: {"ROS 1 topics /scan": {"/scan.malformed": 3}}}


def test_the_audit_covers_a_stream_that_only_lambda_2_has_seen(embedded, bundle, iort):
    car = bundle()
    with Robot(car.folder) as robot:
        robot.online()
        batch = Batch("0badcafe", 2, [T0_US], {"i": [1]})
        assert robot.publish(record_topic(car.robot, "strangers"), encode_batch(batch)) == "SUCCESS"

    def seen():
        return [
            one["stream"]
            for one in json.loads(iort("audit", car.robot, "--json").stdout or '{"streams":[]}')["streams"]
        ]

    until(lambda: "strangers" in seen())
