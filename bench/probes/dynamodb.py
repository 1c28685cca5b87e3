"""Probes of DynamoDB."""

from __future__ import annotations

import uuid
from concurrent.futures import ThreadPoolExecutor

from bench.probes.probe_fixture import AbilityMissingError, ProbeFixture, equal, until
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import batches_between
from iort_contract.tables import BATCH
from iort_contract.topics import RECORD, build_topic
from iort_station.operations import audit

WRITERS = 8


def stores(fixture: ProbeFixture) -> str:
    """An item comes back as it was put."""
    client, table = fixture.cloud.client("dynamodb"), fixture.cloud.output("storage", "RobotsTable")
    item = {
        "robot": {"S": fixture.target.name("bench-ability-item")},
        "value": {"S": uuid.uuid4().hex},
        "n": {"N": "1.5"},
    }
    key = {"robot": item["robot"]}
    client.put_item(TableName=table, Item=item)
    try:
        equal(client.get_item(TableName=table, Key=key, ConsistentRead=True)["Item"], item)
    finally:
        client.delete_item(TableName=table, Key=key)
    return "an item came back as it was put"


def range_of_time(fixture: ProbeFixture) -> str:
    """A range query returns the batches that begin in the range."""
    sent = fixture.drive()
    first, last = batches_between(sent[1].t_us, sent[2].t_us - 1)
    answer = fixture.cloud.client("dynamodb").query(
        TableName=fixture.cloud.output("storage", "TelemetryTable"),
        KeyConditionExpression="topic = :topic AND #batch BETWEEN :a AND :b",
        # A reserved word of DynamoDB.
        ExpressionAttributeNames={"#batch": BATCH},
        ExpressionAttributeValues={
            ":topic": {"S": build_topic(RECORD, fixture.a, VESC_STREAM, fixture.namespace)},
            ":a": {"S": first},
            ":b": {"S": last},
        },
    )
    equal([item[BATCH]["S"] for item in answer["Items"]], [str(sent[1].id)])
    return "of three batches, a range gave the one in it"


def stream_of_changes(fixture: ProbeFixture) -> str:
    """The function behind the stream summarises the stored batches."""
    before = audit.samples_summarized(fixture.cloud, fixture.a, VESC_STREAM)
    fixture.drive()
    until(
        lambda: audit.samples_summarized(fixture.cloud, fixture.a, VESC_STREAM) >= before + 150,
        "the stream's function to write the other table",
    )
    return "batches of one table arrived summarised in the other"


def many_writers(fixture: ProbeFixture) -> str:
    """Threads write as fast as they can; a throttled write raises."""
    client, table = fixture.cloud.client("dynamodb"), fixture.cloud.output("storage", "RobotsTable")

    def write(i: int) -> int:
        key = {"robot": {"S": fixture.target.name(f"bench-writer-{i}")}}
        for n in range(25):
            client.put_item(TableName=table, Item={**key, "n": {"N": str(n)}})
        client.delete_item(TableName=table, Key=key)
        return 25

    with ThreadPoolExecutor(WRITERS) as pool:
        written = sum(pool.map(write, range(WRITERS)))
    return f"{written} writes by {WRITERS} threads, none refused"


def on_demand(fixture: ProbeFixture) -> str:
    """The table describes itself as on demand."""
    table = fixture.cloud.output("storage", "TelemetryTable")
    described = fixture.cloud.client("dynamodb").describe_table(TableName=table)["Table"]
    mode = described.get("BillingModeSummary", {}).get("BillingMode")
    if mode != "PAY_PER_REQUEST":
        raise AbilityMissingError(f"the billing mode is {mode}")
    return f"the table says {mode}"
