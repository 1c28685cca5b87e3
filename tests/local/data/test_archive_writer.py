"""The archive on the embedded cloud, by its schedule, its queue and its own role."""

from __future__ import annotations

import json

from iort_contract.archive import DUE_MS, HOUR, PENDING, ArchiveTable, archived_hour, parse_pending
from iort_contract.tables import TOPIC
from iort_contract.topics import RECORD, build_topic
from testkit.waiting import until
from tests.local.conftest import fire, run_agent
from tests.local.data.drives import RATE_HZ, counter_log

SECONDS = 3


def rows(embedded, topic):
    table = ArchiveTable(embedded.cloud.client("dynamodb"), embedded.cloud.output("storage", "ArchiveTable"))
    return [item for page in table.pages(topic) for item in page.items]


def test_a_drive_is_archived_by_the_schedule_and_by_the_operator(embedded, bundle, iort, tmp_path):
    log = counter_log(tmp_path / "2026-05-04_10-00-00.csv", SECONDS)
    source = {"type": "bag", "path": str(log), "speed": 0, "stamps": "original"}
    car = bundle(sources=[source], live={"enabled": False}, record={"batch_s": 0.2})
    run_agent(car)
    topic = build_topic(RECORD, car.robot, "vesc", embedded.namespace)

    def marked():
        found = (one for partition in PENDING for one in rows(embedded, partition))
        return [one for one in found if parse_pending(one).topic == topic]

    # The operator need not wait until no batch may follow.
    (mark,) = until(marked)
    assert "nothing is archived yet" in iort("archive", "show", car.robot).stderr
    ran = iort("archive", "run", car.robot, "vesc", "--json")
    assert (ran.exit_code, json.loads(ran.stdout)) == (0, {"hours": 1}), ran.output
    row = archived_hour(rows(embedded, topic)[0])
    assert (row.samples, row.refused) == (SECONDS * RATE_HZ, 0)
    verified = iort("archive", "verify", car.robot, "vesc", "--json")
    assert verified.exit_code == 0, verified.output
    assert [stream["samples"] for stream in json.loads(verified.stdout)] == [SECONDS * RATE_HZ]

    # The car sends more of the same hour, and then no batch follows for ten minutes.
    run_agent(car)
    embedded.cloud.client("dynamodb").update_item(
        TableName=embedded.cloud.output("storage", "ArchiveTable"),
        Key={name: mark[name] for name in (TOPIC, HOUR)},
        UpdateExpression="SET #due = :due",
        ExpressionAttributeNames={"#due": DUE_MS},
        ExpressionAttributeValues={":due": {"N": "0"}},
    )
    fire(embedded, "archive-Hourly")
    until(lambda: [parse_pending(one).is_day for one in marked()] == [True])
    (shown,) = json.loads(iort("archive", "show", car.robot, "--json").stdout)
    assert (shown["samples"], shown["hours"]) == (2 * SECONDS * RATE_HZ, 1)
    assert iort("archive", "verify", car.robot, "vesc").exit_code == 0

    # An object that is gone, or not what was written, is found.
    key = archived_hour(rows(embedded, topic)[0]).key
    embedded.cloud.client("s3").put_object(
        Bucket=embedded.cloud.output("storage", "FilesBucket"), Key=key, Body=b"something else"
    )
    wrong = iort("archive", "verify", car.robot, "vesc")
    assert wrong.exit_code == 1
    assert f"{key} is not the object that was written" in wrong.output
