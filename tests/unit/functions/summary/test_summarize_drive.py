"""Lambda 2 against moto's tables, and on a drive of a real car."""

from __future__ import annotations

import random

import pytest

from functions import summarize
from functions.summarize import size_of
from iort_contract.codec.seconds import flat_second
from iort_contract.dynamodb import plain
from iort_contract.messages.batch import Batch
from testkit.dynamodb import ARCHIVE, NAMES, ROBOTS, SUMMARY, TELEMETRY
from tests.recordings import recording
from tests.unit.functions.summary.summarizing import SECOND, T0, S, Stream, batch, counted, drive_of


def test_the_handler_works_on_the_templates_tables(dynamodb, monkeypatch, capsys):
    for name, table in NAMES.items():
        monkeypatch.setenv(f"{name.upper()}_TABLE", table)
    for queue in ("REJECTED", "PUT_OFF"):
        monkeypatch.setenv(f"{queue}_QUEUE", f"https://sqs.example/{queue}")
    monkeypatch.setenv("ARCHIVE_TABLE", ARCHIVE)
    monkeypatch.setenv("ROBOT_METRICS", "false")
    monkeypatch.setenv("RECORD_BYTES_A_DAY", "1")
    dynamodb.put_item(TableName=ROBOTS, Item={"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    stream = Stream(dynamodb)
    drive = [
        batch(T0 + i * S, 50, seq=i, speed=[4614 * i] * 50, text=["a"] * 50) for i in range(40) if i != 7
    ]
    order = list(drive)
    random.Random(1).shuffle(order)
    for start in range(0, len(order), 13):
        records = stream.store(*order[start : start + 13])
        assert summarize.handler({"Records": records}, None) == {"batchItemFailures": []}
    items = [flat_second(plain(item)) for item in dynamodb.scan(TableName=SUMMARY)["Items"]]
    assert sum(item["n"] for item in items) == 39 * 50
    by_second = {int(item["second"]) - SECOND: item for item in items}
    assert {s for s, item in by_second.items() if item["missing_batches"]} == {8}
    assert all(item["speed_mps_mean"] == second for second, item in by_second.items())
    assert counted(capsys)["SamplesSummarized"] == 39 * 50
    row = plain(dynamodb.get_item(TableName=ROBOTS, Key={"robot": {"S": "car"}})["Item"])
    stored = dynamodb.scan(TableName=TELEMETRY)["Items"]
    assert row["record_bytes"] == sum(map(size_of, stored)) > 0
    # The same through the fake: it must behave as moto does.
    fake = Stream()
    fake.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    fake.deliver(*drive)
    assert {int(item["second"]): item for item in items} == fake.summary()


def test_the_drive_of_a_real_car_is_summarised(stream):
    import numpy as np

    samples = list(drive_of(recording("f1tenth-motor-servo.bag")))
    assert len(samples) == 2244
    times = np.array([t_us for t_us, _ in samples])
    names = list(samples[0][1])
    values = {name: np.array([sample[name] for _, sample in samples], dtype=float) for name in names}
    assert len(names) == 13
    gain = 4614.0
    stream.client.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": {"N": "4614"}})
    seconds = sorted(set((times // S).tolist()))
    batches = []
    for seq, second in enumerate(seconds):
        (inside,) = np.nonzero(times // S == second)
        columns = {name: [samples[i][1][name] for i in inside] for name in names}
        batches.append(Batch("aaaaaaaa", seq, times[inside].tolist(), columns))
    random.Random(2).shuffle(batches)
    for b in batches:
        stream.deliver(b)

    summary = stream.summary()
    assert sum(item["n"] for item in summary.values()) == 2244
    assert sum(item["missing_batches"] for item in summary.values()) == 0
    values["speed_mps"] = values["speed"] / gain
    values["power_w"] = values["voltage_input"] * values["current_input"]
    for second, item in summary.items():
        inside = times // S == second
        assert item["n"] == int(inside.sum())
        for name, column in values.items():
            expected = column[inside]
            got = [float(item[f"{name}_{stat}"]) for stat in ("min", "mean", "max", "last")]
            want = [expected.min(), expected.mean(), expected.max(), expected[-1]]
            assert got == pytest.approx(want, rel=1e-8, abs=1e-9), (second, name)
    assert sorted(summary) == seconds
