"""The query function: its selection, its time and memory limits, and the station's reading of its answer."""

from __future__ import annotations

import base64
import io
import json
import zlib

import pytest

from functions.query import answer
from iort_analysis.samples.blocks import values
from iort_contract.messages.batch import Batch
from iort_station import data
from iort_station.errors import StationError
from testkit.dynamodb import ARCHIVE, ROBOTS, TELEMETRY, FakeDynamoDB, item_of, serialize, tables

START = 1_700_000_000_000_000
ENOUGH_MS = 60_000


def table(*batches, page_items=2):
    client = FakeDynamoDB(page_items=page_items)
    for batch in batches:
        client.put(TELEMETRY, item_of(batch))
    row = {"robot": "car", "speed_to_erpm_gain": 10}
    client.put(ROBOTS, {name: serialize(value) for name, value in row.items()})
    return client


def ride(n=100):
    return [
        Batch(
            "0badcafe",
            i // 10,
            [START + k * 20_000 for k in range(i, i + 10)],
            {"speed": list(range(i, i + 10)), "name": ["x"] * 10},
        )
        for i in range(0, n, 10)
    ]


def asked(client, *, left_ms=lambda: ENOUGH_MS, store=None, limits=None, **request):
    event = {"robot": "car", "stream": "vesc", **request}
    reply = answer(event, tables(client), store, left_ms, namespace="iort", **(limits or {}))
    return json.loads(json.dumps(reply))


def unpacked(reply):
    return json.loads(zlib.decompress(base64.b64decode(reply["samples"])))


def test_a_query_returns_the_ranges_samples_that_meet_the_condition():
    reply = asked(
        table(*ride()),
        start_us=START + 200_000,
        end_us=START + 1_000_000,
        fields=["speed_mps", "name"],
        where="speed_mps >= 4.7 and name == 'x'",
    )
    assert unpacked(reply) == {
        "dt": [START + 47 * 20_000, 20_000, 20_000],
        "fields": {"speed_mps": [4.7, 4.8, 4.9], "name": ["x"] * 3},
    }
    assert reply["n"] == 3
    assert reply["token"] is None
    assert set(reply["fields"]) == {"speed", "name", "speed_mps"}


def in_parts(client, **request):
    """The answers from the first one to the one without a token."""
    replies, token = [], None
    while not replies or token is not None:
        replies.append(asked(client, token=token, fields=["speed"], **request))
        token = replies[-1]["token"]
        assert len(replies) < 12
    return replies, [value for reply in replies for value in unpacked(reply)["fields"]["speed"]]


def test_a_query_ends_in_time_and_continues_from_the_token():
    replies, speeds = in_parts(table(*ride()), left_ms=lambda: 0)
    assert {reply["pages"] for reply in replies} == {1}
    assert speeds == list(range(100))


@pytest.mark.parametrize("scan", [False, True])
@pytest.mark.parametrize("page_items", [1, 3, 10, 50])
def test_a_page_over_the_limit_of_values_is_answered_in_parts(page_items, scan):
    client = table(*ride(), page_items=page_items)
    replies, speeds = in_parts(client, limits={"max_values": 50}, scan=scan)
    assert max(reply["n"] for reply in replies) <= 30
    assert sorted(speeds) == list(range(100))


def test_a_large_answer_goes_through_the_bucket():
    kept = []
    reply = asked(
        table(*ride()),
        store=lambda samples: kept.append(samples) or "https://there",
        limits={"max_inline_bytes": 10},
    )
    assert reply["url"] == "https://there"
    assert "samples" not in reply
    assert json.loads(zlib.decompress(kept[0]))["fields"]["speed"] == list(range(100))


def test_invalid_items_are_counted():
    client = table(*ride(20))
    broken = item_of(Batch("0badcafe", 9, [START + 9_000_000], {"speed": [1]}))
    client.put(TELEMETRY, broken | {"samples": serialize("!")})
    reply = asked(client)
    assert (reply["n"], reply["refused"]) == (20, 1)
    assert "base64" in reply["reason"]


@pytest.mark.parametrize(
    ("request_", "reason"),
    [
        ({"robot": "a/b"}, "robot name"),
        ({"where": "speed >"}, "invalid expression"),
        ({"start_us": "now"}, "must be an integer"),
        ({"fields": [1]}, "list of names"),
        ({"where": 7}, ""),
        ({"where": "speed > '3'"}, "speed is a number, '3' is a text"),
    ],
)
def test_an_invalid_request_is_refused_with_the_reason(request_, reason):
    assert reason in asked(table(*ride()), **request_)["error"]


class Cloud:
    """A `iort_station.cloud.Cloud` that runs its functions in this process."""

    namespace, ca_bundle = "iort", None

    def __init__(self, client, *, left_ms=lambda: ENOUGH_MS):
        self._client, self._left_ms = client, left_ms

    def output(self, _noun, name):
        tables = {"TelemetryTable": TELEMETRY, "RobotsTable": ROBOTS, "ArchiveTable": ARCHIVE}
        return tables.get(name, name)

    def client(self, service):
        return {"dynamodb": self._client, "lambda": self}[service]

    def invoke(self, *, FunctionName, Payload):
        assert FunctionName == "QueryFunction"
        reply = asked(self._client, left_ms=self._left_ms, **json.loads(Payload))
        return {"Payload": io.BytesIO(json.dumps(reply).encode())}


@pytest.mark.parametrize("left_ms", [0, ENOUGH_MS])
@pytest.mark.parametrize("scan", [False, True])
@pytest.mark.parametrize(
    "question",
    [
        {},
        {"fields": ["speed_mps"]},
        {"where": "speed % 7 == 0", "start": START + 1, "end": START + 1_500_000},
        {"where": "speed != None and name == 'x'"},
    ],
)
def test_queries_here_and_on_lambda_give_the_same_samples(question, scan, left_ms):
    cloud = Cloud(table(*ride()), left_ms=lambda: left_ms)
    here = data.query(cloud, "car", "vesc", **question)
    there = data.query(cloud, "car", "vesc", on="lambda", scan=scan, **question)
    assert there.times_us.tolist() == here.times_us.tolist()
    assert {k: v.tolist() for k, v in there.columns.items()} == {
        k: v.tolist() for k, v in here.columns.items()
    }
    assert len(here) > 0


COLD = [-273.15, 20.0, 21.5, -50]


@pytest.mark.parametrize("on", ["client", "lambda"])
@pytest.mark.parametrize("motor", [COLD, [*COLD[:2], "cold", -50]])
def test_a_sensor_that_is_not_fitted_is_null_and_counted(on, motor):
    times = [START + i for i in range(4)]
    columns = {"temp_motor": motor, "speed": [1, 2, 3, 4], "ntc_temp_mos1": [-57] * 4}
    cloud = Cloud(table(Batch("0badcafe", 0, times, columns)))

    def query(**question):
        return data.query(cloud, "car", "vesc", on=on, **question)

    whole = query()
    assert values(whole.columns["temp_motor"]) == [None, motor[1], motor[2], None]
    assert values(whole.columns["ntc_temp_mos1"]) == [None] * 4
    assert whole.absent == {"temp_motor": 2, "ntc_temp_mos1": 4}
    if motor is COLD:
        cold = query(where="temp_motor < 0")
        assert (len(cold), cold.absent["temp_motor"]) == (0, 2)
    assert query(fields=["speed"]).absent == {}
    part = query(start=START + 1, end=START + 4, fields=["temp_motor"])
    assert part.absent == {"temp_motor": 1}


def test_exported_messages_have_the_recorded_values():
    columns = {"temp_motor": COLD}
    cloud = Cloud(table(Batch("0badcafe", 0, [START + i for i in range(4)], columns)))
    blocks = data.samples(cloud, data.select("car", "vesc"))
    assert [value for block in blocks for value in block.columns["temp_motor"].tolist()] == COLD


def test_a_mistake_gives_the_same_error_here_and_on_lambda():
    cloud = Cloud(table(*ride()))
    for question, reason in (
        ({"fields": ["volts"]}, "car has no volts in vesc in this range; the nearest: speed"),
        ({"where": "speed > '3'"}, "cannot compare a number with a text: speed is a number"),
        ({"where": "speed > None"}, "None is only allowed as"),
        ({"summary": True}, "query the summary without --on lambda"),
        ({"stream": "imu"}, "car has no stream imu"),
    ):
        with pytest.raises(StationError, match=reason):
            data.query(cloud, **{"robot": "car", "stream": "vesc", "on": "lambda", **question})
