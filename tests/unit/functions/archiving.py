"""The archive's function on moto: what tests store, do and look at."""

from __future__ import annotations

import hashlib
import json

import boto3
import pytest

from functions import archive as function
from functions.shared.archive import archive as archive_of_environment
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.samples.batches import in_order
from iort_analysis.samples.blocks import join, values
from iort_contract.archive import ARCHIVE, HOUR, HOUR_REST_MS, TASK, Hour, Pending
from iort_contract.dynamodb import starting_between
from iort_contract.messages.batch import Batch
from iort_contract.tables import BATCH, EXPIRES_S, TOPIC
from iort_contract.topics import parse_topic
from testkit.dynamodb import FILES, TELEMETRY, TOPIC_OF_CAR, item_of
from tests.unit.contract.contract_values import BOOT

DAY_S = 86_400
RETENTION_S = 90 * DAY_S
# The first hour of a day.
HOUR_0 = Hour(472_224)
NOW_MS = HOUR_0.end_us // 1000 + HOUR_REST_MS + 1
PENDING = Pending(TOPIC_OF_CAR, str(HOUR_0))
DAY = Pending(TOPIC_OF_CAR, HOUR_0.date)
CAR = parse_topic(TOPIC_OF_CAR)
HOUR_1 = Hour(HOUR_0.number + 1)
LATER_MS = NOW_MS + 3 * DAY_S * 1000


class Killed(BaseException):
    """The process ends here."""


class Cloud:
    def __init__(self, dynamodb, s3):
        self.dynamodb, self.s3, self.sqs = dynamodb, s3, boto3.client("sqs")
        self.archive = archive_of_environment()
        self.marks = self.archive.marks

    def store(self, second, speed, hour=HOUR_0, seq=0, now_ms=None):
        """Put a batch of three samples into the table, and mark its hour as Lambda 2 does."""
        start = hour.start_us + second * 1_000_000
        batch = Batch(BOOT, seq, [start, start + 1, start + 2], {"speed": speed})
        item = item_of(batch, expires_s=hour.start_us // 1_000_000 + RETENTION_S)
        self.dynamodb.put_item(TableName=TELEMETRY, Item=item)
        self.marks.note(TOPIC_OF_CAR, [start], now_ms or start // 1000)
        return item

    def forget(self, item):
        self.dynamodb.delete_item(TableName=TELEMETRY, Key={name: item[name] for name in (TOPIC, BATCH)})

    def row(self, hour=HOUR_0):
        return self.archive.row(TOPIC_OF_CAR, hour)

    def archived(self, hour=HOUR_0, now_ms=NOW_MS):
        return function.perform({TASK: ARCHIVE, TOPIC: TOPIC_OF_CAR, HOUR: str(hour)}, now_ms)

    def speeds(self, hour=HOUR_0):
        """What the row's object says."""
        body = self.s3.get_object(Bucket=FILES, Key=self.row(hour).key)["Body"].read()
        assert hashlib.sha256(body).hexdigest() == self.row(hour).sha256
        assert len(body) == self.row(hour).size_bytes
        return values(join(list(in_order(ArchiveFile(body).pages(hour)))).columns["speed"])

    def keys(self):
        return sorted(one["Key"] for one in self.s3.list_objects_v2(Bucket=FILES).get("Contents", ()))

    def pending(self):
        return [pending for pending, _ in self.marks.every()]

    def tasks(self):
        """Take the tasks that wait."""
        url = self.archive.given.archive_queue
        found = []
        while messages := self.sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=10).get("Messages"):
            for message in messages:
                found.append(json.loads(message["Body"]))
                self.sqs.delete_message(QueueUrl=url, ReceiptHandle=message["ReceiptHandle"])
        return found

    def expiries(self):
        keys = starting_between(HOUR_0.start_us, HOUR_0.end_us - 1)
        pages = self.archive.telemetry.pages(TOPIC_OF_CAR, keys)
        return [int(item[EXPIRES_S]["N"]) for page in pages for item in page.items]


def kill(**_):
    raise Killed


@pytest.fixture(name="cloud")
def cloud_of_archive(dynamodb, s3, monkeypatch):
    """An empty deployment."""
    url = boto3.client("sqs").create_queue(QueueName="tasks")["QueueUrl"]
    monkeypatch.setenv("ARCHIVE_QUEUE", url)
    monkeypatch.setenv("RETENTION_S", str(RETENTION_S))
    return Cloud(dynamodb, s3)
