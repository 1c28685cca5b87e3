"""What is read is the same before its batches are archived, after they have expired, and in between."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import random
from pathlib import Path

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from functions.shared.summary import recompute
from iort_analysis.archive import hours as archive_hours
from iort_analysis.archive.stored import Origin
from iort_analysis.samples.batches import RefusedItems
from iort_analysis.samples.blocks import values
from iort_contract.catalog.streams import ACCOUNT_STREAM, TYPES_STREAM
from iort_contract.messages.account import StreamAccount
from iort_contract.messages.batch import Batch, RunEnd
from iort_contract.ros.message import Messages, MessageType, RosType
from iort_contract.tables import RECOMPUTE_FROM_S
from iort_contract.topics import RECORD, build_topic
from iort_station import data
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.data import tabular
from iort_station.data.accounts import accounts
from iort_station.data.runs import overview, runs
from iort_station.errors import StationError
from iort_station.operations import audit
from iort_station.page.answers import answers
from iort_station.page.history import downloads
from iort_station.upkeep import deployment
from iort_station.upkeep.deployment import FAIL
from testkit.dynamodb import ARCHIVE, ROBOTS, TELEMETRY, item_of, item_of_message
from tests import archived
from tests.archived import FakeS3, archive, compact, expire
from tests.unit.contract.ros.ros1_messages import text, u32
from tests.unit.functions.summarizing import Stream
from tests.unit.station.data.test_queries import FakeCloud, cloud_of

HOUR = 3_600_000_000
# Three minutes before a full hour, so that runs and batches cross it.
START = 1_700_000_000_000_000 // HOUR * HOUR + 57 * 60_000_000
S = 1_000_000
CAR = {
    stream: build_topic(RECORD, "car", stream) for stream in ("vesc", "scan", TYPES_STREAM, ACCOUNT_STREAM)
}
SCAN = RosType("/scan", "a_msgs/Names", "2", "string[] names")


def drive() -> list[tuple[str, dict]]:
    """Items of two runs: fields that come and go, flags, texts, sensors that are not fitted, two publishers
    whose batches overlap, messages as published, numbers that lack, and an item that is no batch."""
    items = []

    def add(stream, batch):
        items.append(item_of(batch, CAR[stream]))

    for number, (boot, start, n) in enumerate([("0badcafe", START, 270), ("1badcafe", START + 2 * HOUR, 60)]):
        for seq in range(n):
            t = start + seq * S + 999_000 * (seq % 7 == 3)
            if seq in {30, 31, 179}:
                continue
            times = [t + i * 50_000 for i in range(10)]
            columns = {
                "speed": [seq % 50 + i / 8 for i in range(10)],
                "temp_motor": [20 - 293.15 * (seq == 5)] * 10,
            }
            if seq % 2:
                columns["stamp_ns"] = [t * 1000 + 7 + i for i in range(10)]
            if seq % 90 > 60:
                columns |= {
                    "armed": [i % 2 == 0 for i in range(10)],
                    "mode": ["go" if seq % 2 else None] * 10,
                }
            if seq % 100 == 7:
                columns["mode"] = [2**60 + 1, 1.5, None, True, "x", *[None] * 5]
            previous = (RunEnd("0badcafe", 269),) if number else ()
            add("vesc", Batch(boot, seq, times, columns, seq % 3, None, previous if seq < 3 else None))
            if number:
                again = Batch(
                    "2badcafe", seq, [t + 200_000 + i * 70_000 for i in range(4)], {"speed": [1, 2, None, 4]}
                )
                add("vesc", again)
        kind = MessageType("scan", "/scan", "a_msgs/Names", "2", "string[] names").sample()
        done = StreamAccount("vesc", 2700, 2700, 0, 0, 0, n, ended=not number).sample()
        add(ACCOUNT_STREAM, Batch(boot, 0, [start + n * S], {name: [value] for name, value in done.items()}))
        add(TYPES_STREAM, Batch(boot, 0, [start], {name: [value] for name, value in kind.items()}))
        for seq in range(8):
            raws = [u32(1) + text(f"{boot}{seq}")] * 2
            times = [start + seq * 30 * S, start + seq * 30 * S + 400_000]
            add("scan", Batch(boot, seq, times, {}, 0, Messages(SCAN.id, SCAN.layout, raws)))
    odd = json.dumps(
        {"v": 2, "batch": f"{START + 40 * S:016d}-0badcafe-9999", "codec": "steps", "n": 1, "samples": "eJw="}
    )
    items.append(item_of_message(odd.encode(), CAR["vesc"]))
    return items


ITEMS = drive()


def lab() -> FakeCloud:
    """A cloud with the drive, and with its summary as Lambda 2 makes it."""
    cloud = cloud_of(page_items=100)
    cloud.bucket = FakeS3()
    lambda_2 = Stream(cloud.table)
    records = [lambda_2.store_item(item) for item in ITEMS]
    recompute({"Records": records, RECOMPUTE_FROM_S: 0}, lambda_2.tables)
    return cloud


def later(state: str) -> FakeCloud:
    """The cloud at a later time."""
    cloud = lab()
    cloud.state = state
    if state == "late":
        # They arrived after their hour had been archived, and the others have expired since.
        all_items = dict(cloud.table.items[TELEMETRY])
        for number, key in enumerate(sorted(all_items)):
            if number % 5 == 0:
                del cloud.table.items[TELEMETRY][key]
        archive(cloud.table, cloud.bucket)
        expire(cloud.table)
        cloud.table.items[TELEMETRY] = {
            key: all_items[key] for number, key in enumerate(sorted(all_items)) if number % 5 == 0
        }
        return cloud
    archive(cloud.table, cloud.bucket, expires_s=archived.NEVER_S if state == "archived" else archived.PAST_S)
    if state == "compacted":
        compact(cloud.table, cloud.bucket)
    if state in {"expired", "compacted"}:
        expire(cloud.table)
    if state == "half expired":
        expire(cloud.table, every=lambda number: number % 2 == 0)
    return cloud


STATES = ("archived", "half expired", "expired", "compacted", "late")


@pytest.fixture(scope="module")
def before() -> FakeCloud:
    return lab()


@pytest.fixture(scope="module", params=STATES)
def cloud(request) -> FakeCloud:
    return later(request.param)


def asked(found: data.Result) -> tuple:
    """All that a result says but its origin, as files have it."""
    csv, lines, parquet = io.StringIO(), io.StringIO(), io.BytesIO()
    tabular.to_csv(found, csv)
    tabular.to_json_lines(found, lines)
    tabular.to_parquet(found, parquet)
    told = (
        found.refused,
        found.reason,
        found.ros2,
        found.absent,
        {n: c.dtype for n, c in found.columns.items()},
    )
    return csv.getvalue(), lines.getvalue(), parquet.getvalue(), *told


QUESTIONS = {
    "everything": {},
    "a part of an hour": {"start": START + 60 * S, "end": START + 77 * S},
    "over an hour's end": {
        "start": START + 170 * S,
        "end": START + 190 * S,
        "fields": ["temp_motor", "speed"],
    },
    "a condition": {"where": "speed > 30 and mode is None", "fields": ["speed"]},
    "combined": {"every": "10s", "fields": ["speed", "temp_motor"]},
    "nothing": {"start": START + HOUR, "end": START + HOUR + 1},
    "the summary": {"summary": True},
    "a part of the summary": {"summary": True, "start": START + 170_500_000, "end": START + 2 * HOUR + 9 * S},
    "a field of the summary": {"summary": True, "fields": ["speed", "absent"], "where": "n > 3"},
    "a scan": {"scan": True, "fields": ["speed"]},
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_query_has_the_same_answer(before, cloud, question):
    given_ = QUESTIONS[question]
    expected, found = (data.query(one, "car", "vesc", **given_) for one in (before, cloud))
    assert asked(found) == asked(expected)


@settings(max_examples=10, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(start=st.integers(-2 * S, 280 * S), length=st.integers(1, 5 * S), summary=st.booleans())
def test_any_range_has_the_same_answer(before, cloud, start, length, summary):
    at = START + start
    expected, found = (
        data.query(one, "car", "vesc", at, at + length, summary=summary) for one in (before, cloud)
    )
    assert found.times_us.tolist() == expected.times_us.tolist()
    assert list(found.columns) == list(expected.columns)
    for name, column in found.columns.items():
        assert values(column) == values(expected.columns[name]), name


def test_a_field_that_is_not_in_the_range_is_the_same_error(before, cloud):
    errors = []
    for one in (before, cloud):
        with pytest.raises(StationError, match="car has no mode in vesc in this range") as error:
            data.query(one, "car", "vesc", START + 125 * S, START + 145 * S, fields=["mode"])
        errors.append(str(error.value))
    assert errors[0] == errors[1]


def test_recordings_are_the_same(before, cloud, tmp_path):
    for stream in ("scan", "vesc"):
        asked_for = {"robot": "car", "stream": stream, "from_us": str(START), "to_us": str(START + 3 * HOUR)}
        files = []
        for number, one in enumerate((before, cloud)):
            folder = tmp_path / f"{stream}{number}"
            folder.mkdir()
            made = {name: make(asked_for, folder).read_bytes() for name, make in downloads(one).items()}
            files.append(made)
        assert files[0].keys() == {"history.csv", "history.parquet", "history.mcap"}
        assert files[0] == files[1]


@pytest.mark.parametrize("stream", ["vesc", "scan", ACCOUNT_STREAM])
def test_the_audit_is_the_same(before, cloud, stream):
    for between in ((None, None), (START + 9 * S, START + HOUR)):
        expected, found = (
            audit.audit(stream, audit.headers(one, "car", stream, *between)) for one in (before, cloud)
        )
        assert found == expected
    assert accounts(cloud, "car") == accounts(before, "car")
    assert audit.last_figures(cloud, "car") == audit.last_figures(before, "car")


def test_runs_and_streams_are_the_same_and_say_where_they_are_from(before, cloud):
    for find in (runs, overview):
        origins = Origin(), Origin()
        expected, found = (
            find(one, "car", origin=origin) for one, origin in zip((before, cloud), origins, strict=True)
        )
        assert found == expected
        assert (origins[0].told(), bool(origins[1].told())) == (None, cloud.state != "archived")
    for end_us in (START + HOUR, START + 100 * S):
        assert runs(cloud, "car", end_us=end_us) == runs(before, "car", end_us=end_us)


@pytest.mark.parametrize("verb", ["runs", "streams"])
def test_the_verb_says_what_came_from_the_archive(verb, before, monkeypatch):
    said = []
    for one in (before, later("expired")):
        monkeypatch.setattr(CloudOptions, "cloud", lambda _self, one=one: one)
        done = CliRunner().invoke(app, [verb, "car"])
        told = json.loads(CliRunner().invoke(app, [verb, "car", "--json"]).stdout)
        said.append(("from the archive, 2023-11-14T22:00:00Z to" in done.stderr, told["archive"] is not None))
    assert said == [(False, False), (True, True)]


def test_the_page_gets_the_same_and_says_where_it_is_from(before, cloud):
    for hours in (1, 3):
        question = {
            "robot": "car",
            "stream": "vesc",
            "from_us": str(START),
            "to_us": str(START + hours * HOUR),
            "rows": "50",
        }
        expected, found = (answers(one)["history"](question) for one in (before, cloud))
        assert (expected.pop("archive"), bool(found.pop("archive"))) == (None, cloud.state != "archived")
        assert found == expected


def test_the_query_function_is_not_asked_for_what_has_expired():
    """It reads the table only; half an answer would be wrong."""
    cloud = later("expired")
    with pytest.raises(StationError, match="3 hours of this range have expired, or soon"):
        data.query(cloud, "car", "vesc", START, START + 4 * HOUR, on=data.LAMBDA)


def test_one_of_the_two_alone_can_be_asked(before):
    half = later("half expired")
    counts = {}
    for source in ("auto", "archive", "table"):
        counts[source] = len(data.query(half, "car", "vesc", source=source))
    assert counts["auto"] == counts["archive"] == len(data.query(before, "car", "vesc"))
    assert 0 < counts["table"] < counts["auto"]
    assert len(data.query(half, "car", "vesc", source="table").origin.hours) == 0


def test_of_a_large_file_only_what_is_needed_is_read(monkeypatch):
    chance = random.Random(1)
    cloud = cloud_of(page_items=100)
    cloud.bucket = FakeS3()
    for hour in range(2):
        times = [START + hour * HOUR + i * 1_000 for i in range(1_000)]
        columns = {f"f{i}": [chance.random() for _ in times] for i in range(40)}
        cloud.table.put(TELEMETRY, item_of(Batch("0badcafe", hour, times, columns)))
    expected = data.query(cloud, "car", "vesc", START + HOUR, fields=["f7"])
    archive(cloud.table, cloud.bucket)
    compact(cloud.table, cloud.bucket)
    expire(cloud.table)
    (size,) = map(len, cloud.bucket.objects.values())
    monkeypatch.setattr(archive_hours, "_END_BYTES", 70_000)
    requests, read = [], []
    # The whole file at once; its end and the hour; its end and some columns.
    for most in (size, size - 100_000, 0):
        monkeypatch.setattr(archive_hours, "_AT_ONCE_BYTES", most)
        del cloud.bucket.reads[:]
        assert asked(data.query(cloud, "car", "vesc", START + HOUR, fields=["f7"])) == asked(expected)
        requests.append(len(cloud.bucket.reads))
        read.append(sum(end - start for start, end in cloud.bucket.reads))
    assert requests[:2] == [1, 2]
    assert requests[2] > 2
    assert read[2] < read[1] < read[0] == size


def test_a_file_that_moves_while_it_is_read_is_found_again(before):
    cloud = later("expired")
    rows = [dict(row) for row in cloud.table.items[ARCHIVE].values()]
    compact(cloud.table, cloud.bucket)
    moved = {key: dict(row) for key, row in cloud.table.items[ARCHIVE].items()}
    get, stale = cloud.bucket.get_object, {row["key"]["S"] for row in rows}

    def then(**asked):
        # The first request comes with the old row; then the manifest has the new one.
        if asked["Key"] in stale:
            cloud.table.items[ARCHIVE] = moved
        return get(**asked)

    cloud.bucket.get_object = then
    for row in rows:
        cloud.table.put(ARCHIVE, row)
    assert asked(data.query(cloud, "car", "vesc")) == asked(data.query(before, "car", "vesc"))
    cloud.bucket.objects.clear()
    lost = data.query(cloud, "car", "vesc")
    assert (len(lost), lost.refused) == (0, 3)
    assert "dt/iort/car/vesc at" in lost.reason
    assert "archive/robot=car/" in lost.reason
    assert "is missing: run `iort archive verify`" in lost.reason


def rows_of(cloud, stream="vesc"):
    """The manifest's rows of a stream, by hour."""
    rows = cloud.table.items[ARCHIVE].values()
    return sorted((row for row in rows if row["topic"]["S"] == CAR[stream]), key=lambda row: row["hour"]["S"])


def without_hour(found, hour):
    """The samples of batches that start in other hours; none of the drive's goes on in the next."""
    return [t for t in found.times_us.tolist() if t // HOUR != hour]


@pytest.mark.parametrize("summary", [False, True])
def test_around_a_damaged_file_the_rest_is_read_and_the_hour_is_named(before, summary):
    cloud = later("expired")
    damaged = rows_of(cloud)[0]["key"]["S"]
    cloud.bucket.objects[damaged] = cloud.bucket.objects[damaged][:-300] + bytes(300)
    cut, whole = (data.query(one, "car", "vesc", summary=summary) for one in (cloud, before))
    assert set(without_hour(whole, START // HOUR)) <= set(cut.times_us.tolist())
    assert 0 < len(cut) < len(whole)
    assert cut.refused
    assert f"{damaged} of {CAR['vesc']} is damaged" in cut.reason
    refused = RefusedItems()
    list(audit.headers(cloud, "car", "vesc", refused=refused))
    assert damaged in refused.reason


def test_a_damaged_row_of_the_manifest_is_passed_over_and_named(before):
    cloud = later("expired")
    rows_of(cloud)[0]["batches"] = {"S": "many"}
    found = data.query(cloud, "car", "vesc")
    assert 0 < len(found) < len(data.query(before, "car", "vesc"))
    assert "batches must be an integer, got 'many'" in found.reason


def changed(cloud, name, at):
    """Change a byte of what the batches of some key have stored; returns their keys."""
    items = cloud.table.items[TELEMETRY]
    keys = [key for key in sorted(items) if name in key[1]]
    for key in keys:
        text = bytearray(base64.b64decode(items[key]["samples"]["S"]))
        text[at % len(text)] ^= 4
        items[key] = items[key] | {"samples": {"S": base64.b64encode(bytes(text)).decode()}}
    return [key[1] for key in keys]


@pytest.mark.parametrize("at", [0, 7, 30, -1])
def test_a_changed_byte_of_a_stored_batch_is_named_by_every_verb(monkeypatch, before, at, tmp_path):
    cloud = lab()
    # The item that never was a batch.
    del cloud.table.items[TELEMETRY][CAR["vesc"], "1700002660000000-0badcafe-9999"]
    (key,) = changed(cloud, "-0badcafe-100", at)
    named = f"{CAR['vesc']} at 2023-11-14T22:58:40.000000Z ({key}): "
    monkeypatch.setattr(CloudOptions, "cloud", lambda _: cloud)
    audited = CliRunner().invoke(app, ["audit", "car", "--stream", "vesc", "--json"])
    assert audited.exit_code == 1
    (stream,) = json.loads(audited.stdout)["streams"]
    ((reason,), refused) = stream["named"], stream["refused"]
    assert (reason.startswith(named), refused) == (True, 1)
    whole = audit.audit("vesc", audit.headers(before, "car", "vesc")).runs[0]
    run = next(run for run in stream["runs"] if run["boot"] == whole.boot)
    assert (run["batches"], run["samples"]) == (whole.batches - 1, whole.samples - 10)
    queried = CliRunner().invoke(app, ["query", "car", "vesc", "--last", "all", "--format", "csv"])
    assert named in queried.stderr
    wanted = {"robot": "car", "stream": "vesc", "from_us": str(START), "to_us": str(START + 3 * HOUR)}
    for name, download in downloads(cloud).items():
        path = download(wanted, tmp_path)
        assert path.name.endswith(f"-1-left-out{Path(name).suffix}")
    ((what, text),) = deeply(cloud)[0]
    assert (what, named.removeprefix(f"{CAR['vesc']} ") in text) == ("car vesc", True)


def deeply(cloud):
    """What the doctor's deep look says is damaged, and how many items it has read."""
    items = []
    found = deployment.of_recordings(cloud, deployment.topics(cloud), items.append)
    return [(one.what, one.text) for one in found if one.level == FAIL], sum(items)


def test_the_deep_look_reads_everything_wherever_it_is(cloud):
    damaged, items = deeply(cloud)
    ((what, text),) = damaged
    assert (what, "1700002660000000-0badcafe-9999" in text) == ("car vesc", True)
    assert items >= len(ITEMS)
    # Also of a robot that was removed.
    if cloud.state == "expired":
        rows, cloud.table.items[ROBOTS] = cloud.table.items[ROBOTS], {}
        assert deeply(cloud) == (damaged, items)
        cloud.table.items[ROBOTS] = rows


def _no_digest(cloud):
    key = rows_of(cloud)[1]["key"]["S"]
    content = cloud.bucket.objects[key]
    cloud.bucket.objects[key] = content[:200] + bytes([content[200] ^ 1]) + content[201:]
    return f"{key} is not the object that was written"


def _no_object(cloud):
    key = rows_of(cloud)[1]["key"]["S"]
    del cloud.bucket.objects[key]
    return f"{key} cannot be read: NoSuchKey"


def _no_parquet(cloud):
    row = rows_of(cloud)[1]
    content = cloud.bucket.objects[row["key"]["S"]] = b"PAR1" * 100
    row["sha256"] = {"S": hashlib.sha256(content).hexdigest()}
    return f"{row['key']['S']} is damaged: "


def _other_count(cloud):
    rows_of(cloud)[1]["samples"] = {"N": "5"}
    return "does not hold what the manifest says"


def _no_row(cloud):
    rows_of(cloud)[1]["batches"] = {"S": "many"}
    return "the archive's row 2023-11-14T23: batches must be an integer"


def _no_lines(cloud):
    (key,) = [key for key in cloud.bucket.objects if key.endswith(".jsonl")]
    cloud.bucket.objects[key] = b"{\n"
    return "is damaged: Expecting property name"


def _another_byte(cloud):
    (key,) = changed(cloud, "-0badcafe-100", 20)
    return f"are not as they were archived; the first is {key}"


@pytest.mark.parametrize(
    "damage", [_no_digest, _no_object, _no_parquet, _other_count, _no_row, _no_lines, _another_byte]
)
def test_the_deep_look_names_what_is_damaged_in_the_archive(damage):
    cloud = later("archived" if damage is _another_byte else "expired")
    before, _ = deeply(cloud)
    said = damage(cloud)
    now, _ = deeply(cloud)
    assert any(what == "car vesc" and said in text for what, text in now)
    assert len(now) in {len(before), len(before) + 1, len(before) + 2}


@pytest.mark.parametrize("summary", [False, True])
@pytest.mark.parametrize("state", ["archived", "expired"])
def test_a_range_that_ends_before_1970_is_empty(state, summary):
    cloud = later(state)
    assert len(data.query(cloud, "car", "vesc", -9 * S, -5 * S, summary=summary)) == 0
    assert list(audit.headers(cloud, "car", "vesc", -9 * S, -5 * S)) == []
    assert runs(cloud, "car", start_us=-9 * S, end_us=-5 * S)["runs"] == []
