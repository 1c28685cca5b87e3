"""The telemetry table, its stream and `summarize` in memory, and batches to store."""

from __future__ import annotations

import json
from collections import defaultdict

from functions.shared.summary import process
from iort_contract.catalog.vesc import VESC_FIELDS
from iort_contract.messages.batch import Batch
from testkit.dynamodb import TELEMETRY, TOPIC_OF_CAR, FakeDynamoDB, item_of, record_of, summary_of, tables

S = 1_000_000
SECOND = 1_700_000_000
T0 = SECOND * S


def batch(start_us, n=1, *, step_us=20_000, seq=0, boot="aaaaaaaa", nonfinite=0, **columns):
    """n samples from start_us on; the field i counts them unless columns are given."""
    times = [start_us + i * step_us for i in range(n)]
    return Batch(boot, seq, times, columns or {"i": list(range(n))}, nonfinite)


class Stream:
    """The telemetry table and its stream: what is stored gets a record, and summarize gets records."""

    def __init__(self, client=None):
        self.client = client if client is not None else FakeDynamoDB()
        self.tables = tables(self.client)
        self.records = 0
        self.refused, self.jammed = [], set()

    def store(self, *batches, topic=TOPIC_OF_CAR):
        return [self.store_item(item_of(batch, topic)) for batch in batches]

    def store_item(self, item):
        if isinstance(self.client, FakeDynamoDB):
            self.client.put(TELEMETRY, item)
        else:
            self.client.put_item(TableName=TELEMETRY, Item=item)
        self.records += 1
        return record_of(item, self.records)

    def summarize(self, records):
        return process({"Records": records}, self.tables, self.refuse)

    def refuse(self, refused):
        """A fake dead-letter queue that takes every record not in ``jammed``."""
        self.refused += [one for one in refused if one.number not in self.jammed]
        return [one for one in refused if one.number in self.jammed]

    def deliver(self, *batches, topic=TOPIC_OF_CAR):
        return self.summarize(self.store(*batches, topic=topic))

    def summary(self, topic=TOPIC_OF_CAR):
        return summary_of(self.client, topic)

    def column(self, name):
        return {second - SECOND: item.get(name) for second, item in sorted(self.summary().items())}

    def column_of(self, topic, name):
        return [item.get(name) for _, item in sorted(self.summary(topic).items())]


def counted(capsys):
    totals = defaultdict(int)
    for line in capsys.readouterr().out.splitlines():
        entry = json.loads(line)
        for metric in entry["_aws"]["CloudWatchMetrics"][0]["Metrics"]:
            totals[metric["Name"]] += entry[metric["Name"]]
    return dict(totals)


def clean(summary):
    return {second: dict(item) for second, item in summary.items()}


def drive_of(path):
    """The VESC samples of a bag: time and flat fields."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, stamp_ns, raw in reader.messages():
            if connection.msgtype.endswith("VescStateStamped"):
                state = reader.deserialize(raw, connection.msgtype).state
                sample = {name: getattr(state, name, None) for name in VESC_FIELDS}
                yield stamp_ns // 1000, {k: v for k, v in sample.items() if v is not None}
