"""Hours go to the archive by the deployed function, with its own rights, and are read from there."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
from boto3.dynamodb.types import TypeSerializer

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import BATCH, EXPIRES_S, RECEIVED_MS, TOPIC
from iort_station import data
from iort_station.cloud import Cloud
from iort_station.data import bags, export
from iort_station.data.recorded import telemetry_table, topic_of
from iort_station.errors import StationError
from iort_station.operations import archive, audit
from local.cloud import EmbeddedCloud

HOUR_US, S = 3_600_000_000, 1_000_000
START = 1_700_000_000_000_000 // HOUR_US * HOUR_US
ROBOT, STREAM = "archived", "vesc"


def batches() -> list[Batch]:
    """Batches in two hours, of which the first ends in the second one."""
    made = []
    for seq in range(60):
        begin = START + HOUR_US + (seq - 30) * S - S // 2
        times = [begin + i * 20_000 for i in range(50)]
        made.append(
            Batch("0badcafe", seq, times, {"speed": [seq + i / 50 for i in range(50)], "on": [True] * 50})
        )
    return made


def stored(cloud: Cloud, robot: str) -> list[dict]:
    """The batches as items; they expire in an hour, so that they are read from the archive."""
    serialize = TypeSerializer().serialize
    more = {
        TOPIC: topic_of(cloud, robot, STREAM),
        EXPIRES_S: int(time.time()) + 3600,
        RECEIVED_MS: START // 1000,
    }
    items = []
    for batch in batches():
        item = {**json.loads(encode_batch(batch)), **more}
        items.append({name: serialize(value) for name, value in item.items()})
    return items


@pytest.fixture(scope="module")
def items(embedded: EmbeddedCloud) -> list[dict]:
    found = stored(embedded.cloud, ROBOT)
    telemetry_table(embedded.cloud).put(found)
    return found


def answers(embedded: EmbeddedCloud, folder: Path) -> tuple:
    """What the operator gets of the stream."""
    cloud = embedded.cloud
    found = data.query(cloud, ROBOT, STREAM, fields=["speed", "on"], where="speed > 10")
    with bags.mcap(folder / "ride.mcap", force=True) as file:
        export.write(cloud, data.select(ROBOT, STREAM), file)
    columns = {name: column.tolist() for name, column in found.columns.items()}
    audited = audit.audit(STREAM, audit.headers(cloud, ROBOT, STREAM))
    return found.times_us.tolist(), columns, (folder / "ride.mcap").read_bytes(), audited


def test_what_was_archived_is_read_once_it_has_expired(embedded, items, tmp_path):
    cloud, topic = embedded.cloud, topic_of(embedded.cloud, ROBOT, STREAM)
    before = answers(embedded, tmp_path)
    assert archive.run(cloud, topic) >= 2
    archive.wait(cloud, lambda _left: None)
    # In the table and in the archive, each sample counts once.
    assert answers(embedded, tmp_path) == before
    for item in items:
        key = {name: item[name] for name in (TOPIC, BATCH)}
        cloud.client("dynamodb").delete_item(TableName=cloud.output("storage", "TelemetryTable"), Key=key)
    assert answers(embedded, tmp_path) == before
    found = data.query(cloud, ROBOT, STREAM)
    assert [str(hour) for hour in found.origin.hours] == ["2023-11-14T22", "2023-11-14T23"]
    with pytest.raises(StationError, match="2 hours of this range have expired"):
        data.query(cloud, ROBOT, STREAM, on=data.LAMBDA)
