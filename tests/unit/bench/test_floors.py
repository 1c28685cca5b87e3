"""The floors of functions do the job: they send what the functions send."""

from __future__ import annotations

import json

import pytest

from bench.floors.functions import live as live_floor
from bench.floors.functions import summarize as summarize_floor
from functions.shared.summary import process
from iort_contract.codec import DICTIONARY, flat_second
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import LiveSample, decode_live_update, encode_live
from iort_contract.tables import SECOND, STATS, TOPIC
from testkit.car import RATE_HZ, simulated_drive
from testkit.dynamodb import SUMMARY, TELEMETRY, FakeDynamoDB, item_of, record_of, summary_of, tables

FIRST_US = 1_700_000_000_000_000


class Sent:
    """A connection that keeps what is sent over it."""

    status = 200

    def __init__(self) -> None:
        self.bodies: list[bytes | str] = []

    def request(self, _method: str, _path: str, body: bytes | str, _headers: object = None) -> None:
        self.bodies.append(body)

    def getresponse(self) -> Sent:
        return self

    def read(self) -> bytes:
        return b"{}"


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> Sent:
    connection = Sent()
    monkeypatch.setattr(summarize_floor, "_connection", lambda: (connection, "host"))
    monkeypatch.setattr(live_floor, "_connection", lambda: (connection, "/publish/{channel}"))
    names = "AWS_REGION AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY TABLE TOPIC"
    for name in names.split():
        monkeypatch.setenv(name, name.lower())
    monkeypatch.setenv("DICTIONARY", DICTIONARY.decode())
    return connection


def test_lambda_2s_floor_writes_the_statistics_that_lambda_2_writes(sent: Sent) -> None:
    client, records = FakeDynamoDB(), []
    for seq in range(30):
        samples = simulated_drive(RATE_HZ, after_s=seq)
        times = [FIRST_US + seq * 1_000_000 + i * 1_000_000 // RATE_HZ for i in range(RATE_HZ)]
        item = item_of(Batch("0badcafe", seq, times, {k: [one[k] for one in samples] for k in samples[0]}))
        client.put(TELEMETRY, item)
        records.append(record_of(item, seq))
    process({"Records": records}, tables(client), lambda refused: refused)
    summarize_floor.handler({"Records": records}, None)
    requests = [json.loads(body)["RequestItems"]["table"] for body in sent.bodies]
    assert [len(some) for some in requests] == [25, 5]
    items = [plain(request["PutRequest"]["Item"]) for some in requests for request in some]
    assert len(client.items[SUMMARY]) == len(items)
    ours = {int(second): item for second, item in summary_of(client).items()}
    for item in items:
        floor = flat_second({name: value for name, value in item.items() if name not in {TOPIC, SECOND}})
        theirs = ours[int(item[SECOND])]
        assert sum(name.endswith(f"_{STATS[0]}") for name in floor) == 13
        assert {name: theirs[name] for name in floor} == floor


def test_lambda_1s_floor_publishes_a_live_update(sent: Sent) -> None:
    sample = LiveSample("0badcafe", 3, FIRST_US, FIRST_US + 5, {"speed": 1.5, "fault_code": 0})
    live_floor.handler(rule_event(encode_live(sample), "live/iort/car/vesc", 1_700_000_000_001), None)
    (body,) = sent.bodies
    found = decode_live_update(json.loads(body))
    assert (found.robot, found.stream, found.live) == ("car", "vesc", sample)
