"""Summaries made again after a vehicle's parameters were corrected, by Lambda 2 over tables in memory."""

from __future__ import annotations

import io
import json

import pytest

from functions.shared.summary import process
from functions.shared.summary import recompute as summarize_again
from iort_contract.messages.batch import Batch, RunEnd
from iort_station.errors import StationError
from iort_station.fleet import robots
from iort_station.operations import recompute
from iort_station.operations.recompute import Recomputed
from testkit.dynamodb import ROBOTS, TELEMETRY, item_of, record_of, serialize, summary_of, tables
from tests.unit.station.data.test_queries import START, FakeCloud, cloud_of, ride

SECOND = START // 1_000_000


class Cloud(FakeCloud):
    """The tables in memory and one warm Lambda 2 that has already summarised the ride."""

    def __init__(self, client, *, old_version=False):
        super().__init__(client)
        self.tables, self.old_version, self.events = tables(client), old_version, []
        every = [record_of(item, i) for i, item in enumerate(client.items[TELEMETRY].values())]
        process({"Records": every}, self.tables, lambda _refused: [])

    def client(self, service):
        return self if service == "lambda" else super().client(service)

    def output(self, noun, name):
        return name if noun == "processing" else super().output(noun, name)

    def invoke(self, *, FunctionName, Payload):
        assert FunctionName == "SummarizeFunction"
        self.events.append(json.loads(Payload))
        answer = {} if self.old_version else summarize_again(self.events[-1], self.tables)
        return {"Payload": io.BytesIO(json.dumps(answer).encode())}

    def speeds(self):
        return {at - SECOND: float(item["speed_mps_last"]) for at, item in summary_of(self.table).items()}


def set_gain(cloud, gain):
    cloud.table.put(ROBOTS, {"robot": {"S": "car"}, "speed_to_erpm_gain": serialize(gain)})


def again(cloud, since_us=None):
    streams = recompute.streams(cloud, "car", since_us)
    return {stream: recompute.recompute(cloud, "car", stream, since_us) for stream in streams}


@pytest.fixture
def cloud():
    """Four seconds of a ride, summarised with a gain of 10 that Lambda 2 has cached."""
    return Cloud(cloud_of(*ride(200), gain="10").table)


def test_every_second_has_the_new_speed_after_one_and_two_runs(cloud, capsys):
    assert cloud.speeds() == {0: 4.9, 1: 9.9, 2: 14.9, 3: 19.9}
    capsys.readouterr()
    set_gain(cloud, 20)
    for _ in range(2):
        assert again(cloud) == {"vesc": Recomputed(4, 0)}
        assert cloud.speeds() == {0: 2.45, 1: 4.95, 2: 7.45, 3: 9.95}
    # The metrics have already counted these batches and the missing ones.
    assert capsys.readouterr().out == ""


def test_seconds_before_the_start_time_stay(cloud):
    set_gain(cloud, 20)
    assert again(cloud, START + 2_500_000)["vesc"].seconds == 2
    assert cloud.speeds() == {0: 4.9, 1: 9.9, 2: 7.45, 3: 9.95}


def test_other_values_of_a_second_stay(cloud):
    before = summary_of(cloud.table)
    again(cloud)
    assert summary_of(cloud.table) == before


def test_what_is_missing_of_the_run_before_stays_missing():
    # Of the run before, which had the numbers 0 to 22, the last three have not arrived.
    started_us = START + 5_000_000
    restarted = Batch("0badf00d", 0, [started_us], {"speed": [1]}, previous=(RunEnd("0badcafe", 22),))
    cloud = Cloud(cloud_of(*ride(200), restarted, gain="10").table)
    before = summary_of(cloud.table)
    assert before[SECOND + 5]["missing_batches"] == 3
    again(cloud)
    assert summary_of(cloud.table) == before


def test_a_second_in_two_events_counts_once():
    # 100 batches end in the middle of the seventh second.
    cloud = Cloud(cloud_of(*ride(800, each=3), gain="10").table)
    set_gain(cloud, 20)
    assert again(cloud)["vesc"].seconds == 16
    assert sorted(len(event["Records"]) for event in cloud.events) == [67, 100, 100]
    assert cloud.speeds() == {second: (50 * second + 49) / 20 for second in range(16)}


def test_an_invalid_batch_is_skipped(cloud):
    broken = item_of(Batch("0badcafe", 99, [START + 7], {"speed": [1]}))
    cloud.table.put(TELEMETRY, broken | {"samples": serialize("!")})
    set_gain(cloud, 20)
    assert again(cloud) == {"vesc": Recomputed(4, 1)}


def test_a_stream_without_a_speed_is_not_recomputed():
    cloud = Cloud(cloud_of(*ride(fields=("duty_cycle",)), gain="10").table)
    assert again(cloud) == {}
    assert cloud.events == []


def test_an_outdated_lambda_is_an_error():
    cloud = Cloud(cloud_of(*ride(), gain="10").table, old_version=True)
    with pytest.raises(StationError, match="deploy the current stacks"):
        again(cloud)


@pytest.mark.parametrize(
    ("vehicle", "said"),
    [
        ({"speed_to_erpm_gain": 0.0}, "and not 0, got 0"),
        ({"speed_to_erpm_gain": float("nan")}, "got nan"),
        ({"speed_to_erpm_gain": float("-inf")}, "must be a number from -1e.09 to 1e.09"),
        ({"cells": 2.5}, "cells must be a whole number from 1 to 100, got 2.5"),
        ({"capacity_ah": 0.0}, r"capacity_ah must be a number from 0.01 to 1000 \(Ah\), got 0"),
        ({"speed_to_erpm_offset": 1e10}, "speed_to_erpm_offset must be"),
        (
            {"serial": 1.0},
            "vehicle parameter must be one of speed_to_erpm_gain, .*, capacity_ah, got serial",
        ),
    ],
)
def test_invalid_parameters_are_refused(vehicle, said):
    with pytest.raises(StationError, match=said):
        robots.checked_vehicle(vehicle)


def test_a_negative_gain_and_a_zero_offset_are_valid():
    vehicle = {"speed_to_erpm_gain": -1060.5, "speed_to_erpm_offset": 0.0}
    assert robots.checked_vehicle(vehicle) == vehicle
