"""Batches as they are read into columns, also of the archive's examples."""

from __future__ import annotations

import itertools
import json
import runpy
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.load.message_sizes import stored_bytes
from iort_analysis.samples.batches import RefusedItems, blocks, part
from iort_analysis.samples.blocks import join
from iort_contract.dynamodb import starting_between
from iort_contract.limits import MAX_BATCH_VALUES
from iort_contract.messages.batch import Batch, decode_batch, encode_batch
from iort_contract.ros.message import Messages, RosType
from iort_contract.topics import RECORD, build_topic
from iort_station.data.recorded import Recorded
from testkit.dynamodb import TELEMETRY, FakeDynamoDB, item_of, item_of_message
from tests.archived import FakeS3, archive, compact
from tests.recordings import recording
from tests.unit.contract.ros.ros1_messages import text, u32
from tests.unit.contract.test_codec import BOOT, WRONG, columns, enveloped, message_of
from tests.unit.functions.summarizing import drive_of
from tests.unit.station.data.test_queries import cloud_of


def id_at(second):
    return f"{second * 1_000_000:016}-{BOOT}-0"


def read(*messages):
    """The blocks of messages in one page, and the refused items."""
    refused = RefusedItems()
    items = [item_of_message(json.dumps(message).encode()) for message in messages]
    return list(blocks([items], refused)), refused


@pytest.mark.parametrize("column", [column for column, _ in WRONG])
def test_columns_that_no_encoder_writes_are_refused(column):
    found, refused = read(message_of(column))
    assert (len(found), refused.count) == (0, 1)


def test_a_sum_that_overflows_64_bits_is_refused():
    found, refused = read(message_of([0, 1, *[2**62] * 4, 1], n=6))
    assert (len(found), refused.count) == (0, 1)


# Batches of a foreign robot, as text, because no encoder of ours writes them.
HOSTILE = {
    "deep": "[" * 100_000,
    "deep column": '{"dt":[0,5],"fields":{"f0":' + "[" * 100_000,
    "fields of a list": '{"dt":[0,5],"fields":[]}',
    "no fields": '{"dt":[0,5],"fields":null}',
    "infinite": '{"dt":[0,5],"fields":{"f0":[null,1e999,1]}}',
    "beyond 64 bits": '{"dt":[0,5],"fields":{"f0":[null,18446744073709551616,1]}}',
    "expensive": '{"dt":[0,5],"fields":{"f0":[' + "[]," * 50_000 + "0]}}",
    "beyond a float": '{"dt":[0,5],"fields":{"f0":[null,1' + 400 * "0" + ",1]}}",
}


@pytest.mark.parametrize("body", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_batch_is_refused_and_its_neighbours_are_read(body):
    good = message_of([0, 1, 2])
    strange = enveloped(body.encode(), 2)
    found, refused = read(good, {**strange, "batch": id_at(1)}, {**good, "batch": id_at(2)})
    assert refused.count == 1
    assert [value for block in found for value in block.columns["f0"].tolist()] == [1, 3, 1, 3]


def test_a_batch_with_too_many_values_is_refused_and_its_neighbours_are_read():
    n, good = MAX_BATCH_VALUES // 2 + 1, message_of([0, 1, 2])
    large = message_of([0] * (n + 1), [0] * (n + 1), n=n)
    found, refused = read(good, {**large, "batch": id_at(1)})
    assert refused.count == 1
    assert [value for block in found for value in block.columns["f0"].tolist()] == [1, 3]


@pytest.mark.parametrize("key", ["", "7", f"{0:016}-{BOOT}-x", "~", f"{-1:016}-{BOOT}-0"])
def test_an_item_with_an_invalid_key_is_refused_and_its_neighbours_are_read(key):
    items = [item_of_message(json.dumps(message_of([0, 1, 2])).encode()) for _ in range(2)]
    items[1]["batch"] = {"S": key}
    refused, told = RefusedItems(), []
    cloud = cloud_of()
    cloud.table.query = lambda **how: {"Items": items if how["TableName"] == TELEMETRY else []}
    recorded, keys = Recorded(cloud, "car", "vesc", refused=refused), starting_between(None, None)
    (part,) = recorded.parts(keys, progress=lambda *seen: told.append(seen))
    block = part.block
    # The start of an item without a valid key is unknown, so no time is reported as read.
    assert (block.columns["f0"].tolist(), refused.count, told) == ([1, 3], 1, [(2, 0)])


def test_samples_with_equal_times_are_given_in_the_order_of_their_batches():
    parts = [Batch(BOOT, seq, [t, t, t + 5], {"a": [10 * seq, 10 * seq + 1, 10 * seq + 2]})
             for seq, t in enumerate([1_000, 1_000, 1_005])]  # fmt: skip
    items = [item_of_message(encode_batch(batch)) for batch in parts]
    for pages in ([items], [items[:1], items[1:]], [[item] for item in items]):
        found = list(blocks(pages, RefusedItems()))
        times = [t for block in found for t in block.times_us.tolist()]
        values = [value for block in found for value in block.columns["a"].tolist()]
        assert times == [1_000] * 4 + [1_005] * 4 + [1_010]
        assert values == [0, 1, 10, 11, 2, 12, 20, 21, 22]


FLAT = RosType("/t", "a_msgs/A", "1", "float64 x\nuint8 n")
TEXTS = RosType("/u", "a_msgs/B", "2", "string[] s\nfloat64 x")


def test_messages_are_read_as_samples_or_skipped():
    rows = [struct.pack("<dB", i / 2, i) for i in range(3)]
    texts = [u32(1) + text("a") + struct.pack("<d", 0.5), u32(0) + struct.pack("<d", 1.5), b"odd"]
    odd = [struct.pack("<dB", float("nan"), 7)] * 2
    given = [
        Batch(BOOT, 0, [10, 20, 30], {}, 0, Messages(FLAT.id, FLAT.layout, rows)),
        Batch(BOOT, 1, [110, 120, 130], {}, 0, Messages(TEXTS.id, TEXTS.layout, texts)),
        Batch(BOOT, 2, [210, 220], {}, 0, Messages(FLAT.id, FLAT.layout, odd)),
        Batch(BOOT, 3, [310], {"x": [9.5]}),
    ]
    items = [item_of_message(encode_batch(batch)) for batch in given]
    refused = RefusedItems()
    whole = join(list(blocks([items], refused)))
    assert whole.times_us.tolist() == [10, 20, 30, 110, 120, 130, 210, 220, 310]
    assert list(map(as_read, whole.columns["x"].tolist())) == [
        (0, 0), (0.5, 0), (1, 1), (0.5, 0), (1.5, 1), None, None, None, (9.5, 9),
    ]  # fmt: skip
    assert [value for value in whole.columns["s.0"].tolist() if value is not None] == ["a"]
    assert refused.count == 0
    alone = part(items, refused, messages=False).block
    assert (alone.times_us.tolist(), alone.columns["x"].tolist()) == ([310], [9.5])
    assert refused.count == 0


@given(st.lists(columns(), min_size=1, max_size=4), st.data())
def test_the_station_and_the_contract_read_the_same_batches(parts, data):
    """A page of valid and invalid batches, with columns that change their type."""
    messages, expected, refused = [], [], 0
    for seq, column in enumerate(parts):
        times = [seq * 1_000_000 + 20 * i for i in range(len(column))]
        message = json.loads(encode_batch(Batch(BOOT, seq, times, {"a": column})))
        if data.draw(st.booleans()):
            damaged = message_of(
                [data.draw(st.integers(-1, 30)), 2**62, *[2**62] * (len(times) - 1)], n=len(times)
            )
            message = {**message, "samples": damaged["samples"]}
            refused += 1
        else:
            expected += decode_batch(message).columns["a"]
        messages.append(message)
    found, told = read(*messages)
    got = [value for block in found for value in block.columns["a"].tolist()]
    assert told.count == refused
    assert list(map(as_read, got)) == list(map(as_read, expected))


def as_read(value):
    """The station's form: null is NaN and numbers are floats, unless the column holds other types."""
    if value is None or value != value:  # noqa: PLR0124 - NaN
        return None
    return (
        value if isinstance(value, (str, bool)) else (float(value), int(value) if abs(value) < 2**63 else 0)
    )


def test_a_second_of_a_real_drive_fits_in_a_write_unit_and_is_restored():
    samples = list(drive_of(recording("f1tenth-motor-servo.bag")))
    sizes = []
    for _, group in itertools.groupby(samples, key=lambda sample: sample[0] // 1_000_000):
        second = list(group)
        names = list(second[0][1])
        batch = Batch(BOOT, 0, [t for t, _ in second], {n: [s[n] for _, s in second] for n in names})
        message = encode_batch(batch)
        decoded = decode_batch(message)
        assert {n: list(map(float, c)) for n, c in decoded.columns.items()} == {
            n: list(map(float, c)) for n, c in batch.columns.items()
        }
        sizes.append(stored_bytes(message))
    assert len(sizes) > 40
    assert max(sizes) <= 1024


EXAMPLES = Path(__file__).parents[4] / "docs" / "examples"
DAY_US, HOUR_US, S = 86_400_000_000, 3_600_000_000, 1_000_000
START = 1_700_000_000_000_000 // DAY_US * DAY_US + 22 * HOUR_US


def batches(*, late: bool = False) -> list[Batch]:
    """Four hours around midnight, with a batch across each full hour; ``late`` are some in the first hour."""
    made = []
    for hour in range(4):
        for seq in range(3):
            begin = START + hour * HOUR_US + (seq * S if seq < 2 else HOUR_US - S // 2)
            columns = {"speed": [10.0 * hour + seq, None, 3.0]}
            if hour == 3:
                columns["temp_motor"] = [20.0, 21.0, 22.0]
            made.append(
                Batch("0badcafe", 3 * hour + seq, [begin, begin + S // 4, begin + 3 * S // 4], columns)
            )
    if late:
        made.append(Batch("0badcafe", 99, [START + 60 * S], {"speed": [500.0]}))
    return made


def stored(given: list[Batch]) -> FakeDynamoDB:
    table = FakeDynamoDB()
    for batch in given:
        table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car7", "vesc")))
    return table


@pytest.fixture(params=["hours", "a day", "while a day is joined", "late"])
def copied(request, tmp_path) -> tuple[Path, list[Batch]]:
    """A copy of the archive, and what it holds."""
    table, bucket = stored(batches()), FakeS3()
    archive(table, bucket)
    hours = dict(bucket.objects)
    if request.param != "hours":
        compact(table, bucket)
    if request.param == "while a day is joined":
        bucket.objects |= hours
    if request.param == "late":
        newer = FakeS3()
        archive(stored(batches(late=True)), newer)
        bucket.objects |= {key: body for key, body in newer.objects.items() if key.endswith("/22.parquet")}
    for key, body in bucket.objects.items():
        file = tmp_path / key
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(body)
    return tmp_path / "archive", batches(late=request.param == "late")


@pytest.mark.parametrize("tool", ["pandas", "polars", "duckdb"])
def test_each_sample_counts_once(copied, tool, capsys):
    folder, given = copied
    days: dict[str, list[float | None]] = {"2023-11-14": [], "2023-11-15": []}
    for batch in given:
        days["2023-11-15" if batch.t_us >= START + 2 * HOUR_US else "2023-11-14"] += batch.columns["speed"]
    expected = []
    for day, values in days.items():
        known = [value for value in values if value is not None]
        expected.append(f"{day} {len(values)} {sum(known) / len(known):.6f}")
    runpy.run_path(str(EXAMPLES / f"archive_{tool}.py"))["main"](str(folder), "car7", "vesc")
    assert capsys.readouterr().out.splitlines() == expected
