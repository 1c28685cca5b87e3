"""An hour of stored items becomes Parquet and the same items again, whatever the items hold."""

from __future__ import annotations

import io
import json
import zlib
from functools import partial

import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from iort_analysis.archive import columns, writing
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.reading import items as stored_again
from iort_analysis.archive.writing import Written, write_day, write_hour
from iort_analysis.samples.batches import RefusedItems, blocks, in_order
from iort_analysis.samples.blocks import join, values
from iort_contract.archive import HASH, Hour, content_hash, hour_of, item_hash, parse_hour
from iort_contract.dynamodb import plain, starting_between
from iort_contract.messages.batch import Batch, messages_of
from iort_contract.ros.message import Messages, RosType
from iort_contract.tables import BATCH
from testkit.dynamodb import TOPIC_OF_CAR, item_of, item_of_message
from tests.ros1_strategies import definitions, messages
from tests.unit.contract.contract_values import BOOT, batches, same
from tests.unit.contract.ros import ros_values

HOUR = Hour(472_222)


def written(items, hour=HOUR) -> tuple[ArchiveFile | None, Written, list[dict]]:
    into, refused = io.BytesIO(), io.BytesIO()
    found = write_hour(items, into, hour=hour, refused=refused, scratch=io.BytesIO())
    lines = [json.loads(line) for line in refused.getvalue().splitlines()]
    return ArchiveFile(into.getvalue()) if found.batches else None, found, lines


def by_id(found):
    return [item for _, item in sorted({item[BATCH]["S"]: item for item in found}.items())]


def same_columns(one, other):
    assert one.keys() == other.keys()
    for name, column in one.items():
        assert all(map(same, other[name], column)), (name, column, other[name])


@st.composite
def message_batches(draw):
    """A batch of messages of ROS 1 or 2, that may become columns, or that are kept as published."""
    if draw(st.booleans()):
        made = draw(definitions())
        # A topic for each definition: genmsg's checksum leaves out whether a nested type is an array.
        topic = f"/made_{zlib.crc32(made.definition.encode())}"
        kind, of_kind = RosType(topic, made.kind, made.md5sum, made.definition), messages(made)
    else:
        made = draw(ros_values.definitions(ros2=True))
        kind = RosType("/made", made.kind, "RIHS01_", ros_values.text_of(made))
        of_kind = ros_values.values(made).map(partial(ros_values.by_rosbags, made))
    raws = draw(st.lists(of_kind | st.binary(max_size=8), min_size=1, max_size=4))
    first = draw(st.integers(0, 2**50))
    times = [first + i for i in range(len(raws))]
    beside = draw(st.sampled_from([{}, {"place": ["a"] * len(raws)}]))
    return Batch(BOOT, draw(st.integers(0, 99)), times, beside, 0, Messages(kind.id, kind.layout, raws)), kind


odd_items = st.sampled_from(["{}", '{"v":2,"codec":"steps","n":1,"samples":"eJw="}'])


@settings(suppress_health_check=list(HealthCheck), deadline=None, max_examples=40)
@given(
    st.lists(batches(), max_size=6),
    st.lists(message_batches(), max_size=3),
    st.lists(st.tuples(odd_items, st.integers(0, 2**50)), max_size=2),
    st.sampled_from([columns.MAX_COLUMNS, 2]),
    st.sampled_from([1, 5, 100]),
)
def test_what_an_hour_holds_comes_back(plain_batches, of_messages, odd, most_columns, rows):
    """Batches of all kinds of values, ROS messages byte for byte, refused items, row groups of any size, and
    more fields than an hour has columns."""
    layouts = {kind.id: kind.layout for _, kind in of_messages if kind.layout}
    found = [item_of(batch) for batch in [*plain_batches, *(batch for batch, _ in of_messages)]]
    for text, t_us in odd:
        envelope = {**json.loads(text), BATCH: f"{t_us:016d}-{BOOT}-100"}
        found.append(item_of_message(json.dumps(envelope).encode()))
    items = by_id(found)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(columns, "MAX_COLUMNS", most_columns)
        patched.setattr(writing, "_ROWS", rows)
        file, told, refused = written(items)

    good = [item for item in items if not item[BATCH]["S"].endswith(f"-{BOOT}-100")]
    assert [item for item in items if item not in good] == refused
    assert (told.batches, sum(told.refused.values())) == (len(good), len(refused))
    assert told.content == content_hash((item[BATCH]["S"], item_hash(item)) for item in items)
    if file is None:
        return
    again = list(stored_again(file, TOPIC_OF_CAR))
    assert len(again) == len(good)
    for before, after in zip(good, again, strict=True):
        (one, raw), (other, raw_again) = (messages_of(plain(item), layouts) for item in (before, after))
        same_columns(one.columns, other.columns)
        assert (one.id, one.times_us, one.nonfinite) == (other.id, other.times_us, other.nonfinite)
        assert raw == raw_again
        assert after.keys() - before.keys() <= {HASH}
        assert item_hash(after) == item_hash(before)
    assert list(file.hashes()) == [(item[BATCH]["S"], item_hash(item)) for item in good]
    small = {BATCH, "n", "nonfinite", "previous", "received_ms"}
    heads = [{name: value for name, value in item.items() if name in small} for item in good]
    assert [{k: v for k, v in head.items() if k != HASH} for head in file.headers()] == heads

    expected = join(list(blocks([good], RefusedItems())))
    block = join(list(in_order(file.pages())))
    assert block.times_us.tolist() == expected.times_us.tolist()
    assert block.columns.keys() == expected.columns.keys()
    for name, column in expected.columns.items():
        assert values(block.columns[name]) == values(column), (name, block.columns[name], column)
        if rows == 100 and most_columns > 2:
            assert block.columns[name].dtype == column.dtype, name


def batch_at(hour, second, fields, seq=0, samples=3):
    start = hour.start_us + second * 1_000_000
    return Batch(BOOT, seq, [start + i * 1000 for i in range(samples)], fields)


def speeds(block):
    return values(block.columns["speed"])


def test_a_day_joins_its_hours_and_replaces_one_of_them():
    first, second = HOUR, Hour(HOUR.number + 1)
    one = written([item_of(batch_at(first, 0, {"speed": [1, 2, 3]}))], first)[0]
    # Another type of the same field, and another field.
    other = written([item_of(batch_at(second, 0, {"speed": ["a", None, True], "on": [True] * 3}))], second)[0]
    into = io.BytesIO()
    write_day({second: other, first: one}, into, describe=lambda _name: ("m/s", ""))
    day = ArchiveFile(into.getvalue())
    assert day.hours == [str(first), str(second)]
    assert speeds(join([part.block for part in day.pages(first)])) == [1, 2, 3]
    assert speeds(join([part.block for part in day.pages(second)])) == ["a", None, True]
    assert [part.block.columns.keys() for part in day.pages()] == [{"speed"}, {"speed", "on"}]

    late = written([item_of(batch_at(first, i, {"speed": [i, i, i]}, seq=i)) for i in range(2)], first)[0]
    into = io.BytesIO()
    write_day({first: late, second: day}, into, describe=lambda _name: ("m/s", ""))
    again = ArchiveFile(into.getvalue())
    assert speeds(join([part.block for part in again.pages()])) == [0, 0, 0, 1, 1, 1, "a", None, True]
    assert list(again.hashes(second)) == list(other.hashes())


def test_what_is_not_wanted_is_not_read():
    kind = RosType("/mode", "a_msgs/Mode", "0", "string mode")
    raws = [b"\x02\0\0\0go"] * 3
    start = HOUR.start_us
    of_messages = Batch(BOOT, 9, [start, start, start], {}, 0, Messages(kind.id, kind.layout, raws))
    items = by_id(map(item_of, [batch_at(HOUR, 5, {"speed": [1, 2, 3], "rpm": [4, 5, 6]}), of_messages]))
    file = written(items)[0]
    (part,) = file.pages(wanted={"speed", "mode"}.__contains__)
    assert values(part.block.columns["mode"]) == ["go"] * 3 + [None] * 3
    assert part.block.columns.keys() == {"speed", "mode"}
    assert part.start_us == HOUR.start_us + 5_000_000
    (part,) = file.pages(messages=False)
    assert part.block.columns.keys() == {"speed", "rpm"}
    (part,) = file.pages(keys=starting_between(None, HOUR.start_us))
    assert part.block.columns.keys() == {"mode"}
    assert not list(file.pages(keys=starting_between(HOUR.end_us, None)))
    assert not list(file.pages(keys=starting_between(None, HOUR.start_us - 1)))


def test_only_the_parts_with_the_wanted_batches_are_read(monkeypatch):
    monkeypatch.setattr(writing, "_ROWS", 30)
    batches = [batch_at(HOUR, second, {"speed": [1.0, 2.0, 3.0]}, seq=second) for second in range(1000)]
    file, _, _ = written(list(map(item_of, batches)))
    keys = starting_between(batches[400].times_us[0], batches[404].times_us[0])
    assert len(file.groups()) > 5
    assert len(file.groups(HOUR, keys)) <= 2
    some = list(stored_again(file, TOPIC_OF_CAR, HOUR, keys))
    assert [item[BATCH]["S"] for item in some] == [str(batch.id) for batch in batches[400:405]]
    every = {item[BATCH]["S"]: item for item in stored_again(file, TOPIC_OF_CAR, HOUR)}
    assert all(every[item[BATCH]["S"]] == item for item in some)


def test_much_text_does_not_stay_in_memory_for_an_hour(monkeypatch):
    monkeypatch.setattr(writing, "_BYTES", 100_000)
    items = [item_of(batch_at(HOUR, i, {"log": ["x" * 4000] * 3}, seq=i)) for i in range(300)]
    file, told, _ = written(items)
    assert told.batches == 300
    assert len(file.groups()) == 3


def test_other_tools_find_names_units_and_a_sample_a_row():
    items = [item_of(batch_at(HOUR, 0, {"speed": [1, 2.5, None], "time": [7, 8, 9]}))]
    into = io.BytesIO()
    write_hour(
        items,
        into,
        hour=HOUR,
        refused=io.BytesIO(),
        scratch=io.BytesIO(),
        describe=lambda name: ("rpm", "speed of the motor") if name == "speed" else ("", ""),
    )
    table = pq.read_table(io.BytesIO(into.getvalue()))
    assert table.schema.field("speed").metadata == {
        b"iort:field": b"speed",
        b"iort:unit": b"rpm",
        b"iort:meaning": b"speed of the motor",
    }
    assert table["speed"].to_pylist() == [1.0, 2.5, None]
    assert table["_time"].to_pylist() == [7.0, 8.0, 9.0]
    assert table["time"][0].as_py().isoformat() == f"{hour_of(HOUR.start_us)}:00:00+00:00"
    assert parse_hour(str(HOUR)) == HOUR
