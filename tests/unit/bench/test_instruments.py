"""What the instruments rest on: floors, loads, and the verdict about a try."""

from __future__ import annotations

import json

import pytest

from bench.floors import live as live_floor
from bench.floors import summarize as summarize_floor
from bench.floors.raw_mqtt import _packet, _text
from bench.load.course import Heard, Try
from bench.load.generator import laps
from functions.shared.summary import process
from iort_contract.codec import DICTIONARY, flat_second
from iort_contract.dynamodb import plain
from iort_contract.limits import MAX_BATCH_VALUES, MAX_MESSAGE_BYTES, ContractError
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.live import LiveSample, decode_live_update, encode_live
from iort_contract.tables import SECOND, STATS, TOPIC
from testkit.car import RATE_HZ, simulated_drive
from testkit.dynamodb import SUMMARY, TELEMETRY, FakeDynamoDB, item_of, record_of, summary_of, tables
from testkit.worst_case import cases, worst_batches


@pytest.mark.parametrize(
    ("length", "head"),
    [(0, b"\x30\x00"), (127, b"\x30\x7f"), (128, b"\x30\x80\x01"), (16_384, b"\x30\x80\x80\x01")],
)
def test_the_remaining_length_is_encoded_as_in_the_standard(length, head):
    assert _packet(0x30, b"x" * length)[: len(head)] == head
    assert len(_packet(0x30, b"x" * length)) == len(head) + length


def test_a_text_is_prefixed_with_its_length():
    assert _text("größe".encode()) == b"\x00\x07" + "größe".encode()


def test_a_lap_has_every_sample_of_its_second():
    assert [len(lap["voltage_input"]) for lap in laps(20)] == [20] * 60


def tried(*heard: tuple[float, float]) -> Try:
    """The failure is at 10 s; each message is a time and a speed."""
    return Try(10.0, [Heard(at, 0.0, speed) for at, speed in heard])


@pytest.mark.parametrize(
    ("heard", "why"),
    [
        ([(9.9, 1.0), (10.1, 1.0), (10.55, 0.0)], ""),
        ([(9.9, 1.0), (10.6, 0.0)], "the stop came 600 ms after the last motion or the failure"),
        ([(9.9, 1.0), (10.1, 0.0), (10.2, 1.0), (10.3, 0.0)], "a motion came 100 ms after the first stop"),
        ([(9.9, 1.0), (10.1, 0.0), (10.2, 1.0)], "no stop"),
        ([(9.9, 1.0)], "no stop"),
    ],
)
def test_a_try_tells_why_it_failed(heard: list[tuple[float, float]], why: str) -> None:
    one = tried(*heard)
    assert one.driven
    assert one.why == why


def test_a_car_that_stood_already_is_no_try() -> None:
    assert not tried((9.8, 1.0), (9.9, 0.0), (10.1, 0.0)).driven
    assert tried((9.9, 0.0), (10.1, 1.0), (10.2, 0.0)).driven, "it moved after the failure"


def test_only_unbounded_batches_are_refused():
    refused = []
    for case in cases():
        assert len(case.message) <= MAX_MESSAGE_BYTES
        try:
            decode_batch(case.message)
        except ContractError as error:
            refused.append(str(error))
        else:
            refused.append("")
    assert [reason[:12] for reason in refused] == ["samples must"] * 2 + [""] * 3


def test_each_worst_batch_covers_one_second():
    found = [decode_batch(message) for message in worst_batches(3, first_us=5_000_000)]
    assert [(batch.t_us, batch.seq) for batch in found] == [(5_000_000, 0), (6_000_000, 1), (7_000_000, 2)]
    assert {len(batch.times_us) for batch in found} == {MAX_BATCH_VALUES}


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
