"""A robot's share of the processor: batches over it wait, and the robot is notified."""

from __future__ import annotations

import itertools
import json

import pytest
from botocore.exceptions import ClientError

from functions import later
from functions.shared import quotas, share
from functions.shared.metrics import MOST_VALUES
from functions.shared.quotas import RateLimiter
from functions.shared.share import KEYS, OverShareError, PutOff, Share, Told, waiting
from functions.shared.summary import Bounds, measure, process, together
from functions.summarize import EVERY_S, PARTS, Volume, size_of
from iort_contract.catalog.streams import AGENT_STREAM, RTT_STREAM
from iort_contract.catalog.vesc import TEMPERATURES, VESC_STREAM, hottest_degc
from iort_contract.dynamodb import TableError
from iort_contract.messages.batch import Batch
from iort_contract.tables import (
    BATCH,
    OVER_SHARE,
    PUT_OFF,
    PUT_OFF_TO_S,
    RECORD_BYTES,
    RECORD_DAY,
    ROBOT,
    TOPIC,
)
from iort_contract.topics import RECORD, SHADOW, build_topic
from testkit.dynamodb import ROBOTS
from tests.unit.functions.summarizing import T0, S, Stream, batch, counted

GOOD, BAD = (build_topic(RECORD, robot, VESC_STREAM) for robot in ("good", "bad"))


class Processor:
    """A fake processor clock: each look advances it by ``each_s``."""

    def __init__(self, each_s=0.0):
        self.each_s, self.now_s = each_s, 0.0

    def __call__(self):
        self.now_s += self.each_s
        return self.now_s


class Queue:
    """A fake SQS; it takes no message while it is ``full``."""

    def __init__(self):
        self.sent, self.full = [], False

    def send_message_batch(self, *, QueueUrl, Entries):
        assert QueueUrl == "queue"
        assert 1 <= len(Entries) <= 10
        if self.full:
            return {"Failed": [{"Id": entry["Id"], "Code": "InternalError"} for entry in Entries]}
        self.sent += Entries
        return {"Successful": Entries}


class Shadows:
    """A fake of iot-data's shadows."""

    def __init__(self, *, fails=False):
        self.said, self.fails = [], fails

    def update_thing_shadow(self, *, thingName, shadowName, payload):
        if self.fails:
            raise ClientError({"Error": {"Code": "InternalFailureException"}}, "UpdateThingShadow")
        assert shadowName == SHADOW
        self.said.append((thingName, json.loads(payload)["state"]["desired"][OVER_SHARE]))


class Bounded(Stream):
    """The stream and Lambda 2 with limited shares. Each look at the processor's time costs ``each_s``."""

    def __init__(self, each_s):
        super().__init__()
        self.queue, self.shadows = Queue(), Shadows()
        put_off = PutOff(self.queue, queue_url="queue")
        self.share = Share(spent_s=Processor(each_s))
        self.bounds = Bounds(self.share, put_off.put, Told(self.shadows).tell)

    def stored_at(self, at_s, *batches, topic):
        records = self.store(*batches, topic=topic)
        for record in records:
            record["dynamodb"]["ApproximateCreationDateTime"] = at_s
        return records

    def summarize(self, records):
        return process({"Records": records}, self.tables, self.refuse, bounds=self.bounds)

    def summarize_later(self):
        """Summarise the queue's batches as the later function does."""
        for entry in self.queue.sent:
            records = later.records(self.tables, entry["MessageBody"])
            answer = process({"Records": records}, self.tables, self.refuse, beside_others=True)
            assert answer == {"batchItemFailures": []}

    def waits(self):
        return [key for entry in self.queue.sent for key in waiting(entry["MessageBody"])]


def many(count, *, first=0):
    return [batch(T0 + (first + i) * S, seq=first + i) for i in range(count)]


def test_a_rate_limiter_refills_with_time():
    limiter = RateLimiter(burst=1.0, a_second=0.1)
    assert limiter.spend("car", 0.0, 3.0) == -2.0
    assert limiter.left("other", 0.0) == 1.0
    assert limiter.left("car", 20.0) == pytest.approx(0.0)
    assert limiter.left("car", 1000.0) == 1.0
    # A clock that was set back neither drains nor refills the rate limiter.
    assert limiter.spend("car", -100.0, 0.0) == -2.0
    assert limiter.left("car", 20.0) == pytest.approx(0.0)


def test_a_rate_limiter_remembers_a_bounded_number_of_robots():
    limiter = RateLimiter(burst=1.0, a_second=0.1)
    for i in range(quotas._ROBOTS + 1):
        limiter.spend(f"car{i}", 0.0, 0.5)
    assert (limiter.left("car0", 0.0), limiter.left("car1", 0.0)) == (1.0, 0.5)


def test_a_meter_charges_its_threads_time_and_stops_far_over_the_share():
    processor = Processor()
    bounded = Share(burst_s=1.0, a_second=0.1, spent_s=processor)
    meter = bounded.meter("car", 0.0)
    processor.now_s = 0.75
    assert meter.charge(0.25) == 0.0
    assert bounded.over("car", 0.0)
    assert not bounded.over("other", 0.0)
    # Work that has begun continues up to twice the share.
    processor.now_s = 1.75
    meter.check()
    processor.now_s = 1.8
    with pytest.raises(OverShareError):
        meter.check()
    assert not Share.unlimited().over("car", 0.0)


def test_batches_over_the_share_wait_and_other_robots_batches_do_not(capsys):
    stream = Bounded(each_s=0.1)
    records = stream.stored_at(100.0, *many(30), topic=BAD)
    good = stream.stored_at(100.0, batch(T0, 50), topic=GOOD)
    assert stream.summarize([*records, *good]) == {"batchItemFailures": []}
    assert set(stream.summary(GOOD)) == {T0 // S}
    done = set(stream.summary(BAD))
    assert len(done) < 30
    totals = counted(capsys)
    assert totals["BatchesPutOff"] == len(stream.waits()) == 30 - len(done)
    assert totals["BatchesSummarized"] == 1 + len(done)
    # The robot's name stands beside its batches; no message mixes robots.
    assert {entry["MessageGroupId"] for entry in stream.queue.sent} == {"bad"}
    assert {topic for topic, _ in stream.waits()} == {BAD}
    stream.summarize_later()
    assert set(stream.summary(BAD)) == {T0 // S + i for i in range(30)}
    assert set(stream.column_of(BAD, "missing_batches")) == {0}


def test_a_robot_back_within_its_share_is_summarised_at_once():
    stream = Bounded(each_s=0.1)
    stream.summarize(stream.stored_at(100.0, *many(30), topic=BAD))
    assert (before := len(stream.waits()))
    stream.summarize(stream.stored_at(101.0, *many(1, first=30), topic=BAD))
    assert len(stream.waits()) == before + 1
    stream.summarize(stream.stored_at(200.0, *many(1, first=31), topic=BAD))
    assert len(stream.waits()) == before + 1
    assert T0 // S + 31 in stream.summary(BAD)


def test_undecodable_batches_are_charged_to_their_robot():
    stream = Bounded(each_s=0.1)
    records = stream.stored_at(100.0, *many(30), topic=BAD)
    for record in records:
        record["dynamodb"]["NewImage"]["samples"] = {"S": "no base64"}
    stream.summarize(records)
    assert len(stream.refused) + len(stream.waits()) == 30
    assert len(stream.refused) < 12


def test_seconds_that_are_expensive_to_read_again_wait():
    """The batch is cheap, but the second's other batches in the table cost more than the share."""
    stream = Bounded(each_s=0.0)
    stream.store(*(batch(T0 + i * 10_000, seq=i) for i in range(60)), topic=BAD)
    records = stream.stored_at(100.0, batch(T0 + 990_000, seq=60), topic=BAD)
    stream.share._spent_s.each_s = 0.1
    assert stream.summarize(records) == {"batchItemFailures": []}
    assert len(stream.waits()) == 1
    stream.share._spent_s.each_s = 0.0
    stream.summarize_later()
    assert stream.column_of(BAD, "n") == [61]


def test_batches_that_the_queue_does_not_take_stay_in_the_stream():
    stream = Bounded(each_s=0.1)
    stream.queue.full = True
    records = stream.stored_at(100.0, *many(30), topic=BAD)
    failed = stream.summarize(records)["batchItemFailures"]
    assert len(failed) + len(stream.summary(BAD)) == 30
    numbers = {record["dynamodb"]["SequenceNumber"] for record in records}
    assert {one["itemIdentifier"] for one in failed} <= numbers


def test_deferred_batches_are_sent_in_bounded_messages_and_calls():
    queue = Queue()
    stream = Stream()
    changes = [one["dynamodb"] for one in stream.store(*many(KEYS * 12 + 1), topic=BAD)]
    assert PutOff(queue, queue_url="queue").put(changes) == []
    sizes = [len(json.loads(entry["MessageBody"])[PUT_OFF]) for entry in queue.sent]
    assert sizes == [KEYS] * 12 + [1]


def test_deferred_batches_that_were_deleted_are_skipped():
    stream = Stream()
    body = json.dumps({PUT_OFF: [[BAD, "0000000000000000-0badcafe-0"]]})
    assert later.records(stream.tables, body) == []


def test_a_second_that_changed_meanwhile_is_read_again():
    """While the later function has read but not written, Lambda 2 summarises a new batch."""
    stream = Stream()
    first, second = batch(T0, seq=0), batch(T0 + 500_000, seq=1)
    records = stream.store(first)
    put_seconds, late = stream.tables.put_seconds, [second]

    def slow(seconds):
        while late:
            newer = stream.store(late.pop())
            process({"Records": newer}, stream.tables, stream.refuse)
        put_seconds(seconds)

    stream.tables.put_seconds = slow
    process({"Records": records}, stream.tables, stream.refuse, beside_others=True)
    assert stream.column("n") == {0: 2}


def test_a_robot_is_notified_at_once_then_at_intervals_and_anew_after_a_pause():
    shadows = Shadows()
    told = Told(shadows)
    for at_s in (100.0, 101.0, 129.0, 131.0):
        told.tell("bad", 10, at_s)
    told.tell("other", 1, 131.0)
    told.tell("bad", 5, 131.0 + share.OVER_S + 1)
    assert shadows.said == [
        ("bad", {"batches": 10, "since_ms": 100_000, "last_ms": 100_000}),
        ("bad", {"batches": 40, "since_ms": 100_000, "last_ms": 131_000}),
        ("other", {"batches": 1, "since_ms": 131_000, "last_ms": 131_000}),
        ("bad", {"batches": 5, "since_ms": 192_000, "last_ms": 192_000}),
    ]


def test_a_failed_notification_loses_no_summary(caplog):
    Told(Shadows(fails=True)).tell("bad", 1, 100.0)
    assert "bad is not told" in caplog.text


def test_the_number_of_remembered_notifications_is_bounded():
    told = Told(Shadows())
    for i in range(share._ROBOTS + 10):
        told.tell(f"car{i}", 1, 100.0)
    assert len(told._robots) == share._ROBOTS


def test_counting_holes_before_every_batch_is_within_the_share():
    stream = Bounded(each_s=0.0)
    stream.stored_at(99.0, *(batch(T0 + i * S // 100, seq=2 * i) for i in range(1000)), topic=BAD)
    new = [batch(T0 + 10 * S + i * S // 100, seq=2 * (1000 + i)) for i in range(100)]
    records = stream.stored_at(100.0, *new, topic=BAD)
    before = stream.client.calls["query"]
    stream.summarize(records)
    # One query a page around the second, and a few for the batches.
    assert stream.client.calls["query"] - before < 30


def test_counting_a_robots_holes_stops_over_the_share():
    stream = Bounded(each_s=0.0)
    processor, numbers = stream.share._spent_s, stream.tables.numbers

    def slow(*asked):
        processor.now_s += 0.25
        return numbers(*asked)

    stream.tables.numbers = slow
    records = stream.stored_at(100.0, *(batch(T0 + i * S, seq=2 * i) for i in range(10)), topic=BAD)
    stream.summarize(records)
    assert processor.now_s < 1.0
    assert len(stream.waits()) == 10


def test_a_second_that_changes_at_every_read_does_not_block():
    stream = Bounded(each_s=0.0)
    records = stream.store(batch(T0 + 500_000, seq=100), topic=BAD)
    put, sent = stream.tables.put_seconds, itertools.count(1)

    def put_and_send(seconds):
        number = next(sent)
        assert number < 20, "it does not end"
        stream.store(batch(T0 + 500_000 - number, seq=100 - number), topic=BAD)
        put(seconds)

    stream.tables.put_seconds = put_and_send
    with pytest.raises(TableError, match="change as fast"):
        process({"Records": records}, stream.tables, stream.refuse, beside_others=True)


# What a robot records a day is counted in its row, at little cost, and too much is an alarm.

MOST, NOON_S = 1_000_000, 1_700_049_600.0
CAR = {"S": "car7"}


def change(size: int, *, robot: str = "car7", **more: dict) -> dict:
    keys = {TOPIC: {"S": f"dt/iort/{robot}/vesc"}, BATCH: {"S": "1"}}
    image = {**keys, "samples": {"S": "a" * size}, **more}
    return {"Keys": keys, "NewImage": image, "SequenceNumber": "1"}


@pytest.fixture
def row(dynamodb):
    dynamodb.put_item(TableName=ROBOTS, Item={ROBOT: CAR})
    return lambda: dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: CAR})["Item"]


@pytest.fixture
def volume(dynamodb):
    return Volume(dynamodb, ROBOTS, MOST)


def test_a_part_of_the_day_or_some_minutes_are_one_write(row, volume):
    part = change(MOST // PARTS // 2)
    volume.note([part], NOON_S)
    assert row() == {ROBOT: CAR}
    volume.note([part], NOON_S + 1)
    size = 2 * size_of(part["NewImage"])
    assert row() == {ROBOT: CAR, RECORD_DAY: {"S": "2023-11-15"}, RECORD_BYTES: {"N": str(size)}}
    # A small robot's count is written after some minutes, also by another environment.
    volume.note([change(10)], NOON_S + 2)
    volume.note([], NOON_S + 2 + EVERY_S)
    assert int(row()[RECORD_BYTES]["N"]) == size + size_of(change(10)["NewImage"])


def test_above_its_bytes_a_robot_is_named_and_counted_and_the_next_day_is_new(row, volume, caplog, capsys):
    big = change(MOST // 2)
    volume.note([big], NOON_S)
    assert counted(capsys) == {}
    volume.note([big], NOON_S)
    assert "car7 has recorded" in caplog.text
    assert f"more than its {MOST}" in caplog.text
    assert counted(capsys) == {"RobotsOverVolume": 1}
    volume.note([big], NOON_S + 86_400)
    assert row()[RECORD_DAY] == {"S": "2023-11-16"}
    assert row()[RECORD_BYTES] == {"N": str(size_of(big["NewImage"]))}


def test_what_no_robot_wrote_is_not_counted(row, volume):
    removed = {name: value for name, value in change(9).items() if name != "NewImage"}
    foreign = {**change(MOST), "Keys": {TOPIC: {"S": "nonsense"}}}
    volume.note([change(MOST, **{PUT_OFF_TO_S: {"N": "1"}}), removed, foreign], NOON_S)
    assert row() == {ROBOT: CAR}


def test_a_removed_robot_gets_no_row(dynamodb, volume):
    volume.note([change(MOST, robot="gone")], NOON_S)
    assert "Item" not in dynamodb.get_item(TableName=ROBOTS, Key={ROBOT: {"S": "gone"}})


def test_a_failed_count_stops_nothing(dynamodb, caplog):
    Volume(dynamodb, "no-such-table", MOST).note([change(MOST)], NOON_S)
    assert "are not counted" in caplog.text


def test_bytes_in_an_event_are_in_base64():
    assert size_of({"samples": {"B": "AAAA"}}) == size_of({"samples": {"B": b"AAA"}})


# Health: the metrics that follow from a car's batches.


def measured_batch(columns, *, times_us=None):
    length = len(next(iter(columns.values())))
    return Batch("0" * 8, 0, times_us or [1_000_000 + 20_000 * i for i in range(length)], columns)


def test_the_worst_values_of_a_drive_are_measured():
    first = measured_batch({"voltage_input": [12.1, 11.9], "temp_fet": [40.0, 41.5], "fault_code": [0, 5]})
    hot = {"voltage_input": [11.2, 11.6], "temp_fet": [0.0, 39.0], "temp_motor": [55.5, None]}
    measured = measure("vesc", [first, measured_batch(hot)])
    worst = {"BatteryVolts": [11.2], "TemperatureDegC": [55.5]}
    assert measured == {"SampleGaps": 0, "FaultSamples": 1, **worst}


@pytest.mark.parametrize(
    ("stream", "columns"),
    [
        ("vesc", {"voltage_input": [0.0, None], "temp_fet": [0, 0]}),
        ("vesc", {"voltage_input": [0.0], "temp_motor": [-273.15], "temp_fet": [-57]}),
        ("imu", {"x": [1.0], "fault_code": ["odd"], "voltage_input": [True]}),
    ],
)
def test_unmeasured_values_are_not_counted(stream, columns):
    nothing = {"SampleGaps": 0, "FaultSamples": 0, "BatteryVolts": [], "TemperatureDegC": []}
    assert measure(stream, [measured_batch(columns)]) == nothing


def test_a_hole_is_a_gap():
    times_us = [0, 20_000, 40_000, 60_000, 200_000, 220_000]
    assert measure("vesc", [measured_batch({"x": [0.0] * 6}, times_us=times_us)])["SampleGaps"] == 1


def test_round_trips_and_the_agents_own_figures_are_measured():
    rtt = measured_batch({"broker_ms": [12.0, None], "rule_ms": [None, 31.5], "lambda_ms": [None, None]})
    figures = {"RoundTripBrokerMs": [12.0], "RoundTripRuleMs": [31.5], "RoundTripLambdaMs": []}
    assert measure(RTT_STREAM, [rtt]) == figures
    agent = measured_batch({"backlog_batches": [0, 7], "thread_errors": [0, 2]})
    assert measure(AGENT_STREAM, [agent]) == {"AgentReports": 2, "BacklogBatches": [7.0], "ThreadErrors": 2}


def test_several_robots_share_one_log_line_without_loss_of_values():
    one = {"SampleGaps": 1, "FaultSamples": 0, "BatteryVolts": [11.2], "TemperatureDegC": []}
    rtt = {"RoundTripBrokerMs": [5.0] * 3}
    (line,) = together([one, {**one, "BatteryVolts": [12.0]}, rtt])
    assert line == {**one, "SampleGaps": 2, "BatteryVolts": [11.2, 12.0], **rtt}
    many = list(together({**one, "BatteryVolts": [float(n)]} for n in range(MOST_VALUES + 1)))
    assert [len(line["BatteryVolts"]) for line in many] == [MOST_VALUES, 1]
    assert sum(line.get("SampleGaps", 0) for line in many) == MOST_VALUES + 1
    assert list(together([])) == [{}]


def test_the_alarm_and_the_watch_use_the_same_hottest_temperature() -> None:
    for hot in TEMPERATURES:
        sample = {**dict.fromkeys(TEMPERATURES, 20.0), hot: 81.5}
        measured = measure("vesc", [measured_batch({name: [value] for name, value in sample.items()})])
        assert measured["TemperatureDegC"] == [81.5] == [hottest_degc(sample)]
    unread = {"temperature_pcb": 0, "temp_fet": -60.0, "temp_motor": None, "ntc_temp_mos1": True}
    assert hottest_degc(unread) is None
    assert hottest_degc({**unread, "ntc_temp_mos2": -3.5}) == -3.5
