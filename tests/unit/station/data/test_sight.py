"""`iort sight`: each motion command beside the picture that its driver saw, and the pictures themselves."""

from __future__ import annotations

import hashlib
import io
import json
from typing import Any, cast

import numpy as np
import pytest
from mcap.writer import Writer
from PIL import Image
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from iort_agent.video import Frame
from iort_agent.video.kept import compressed_image, message
from iort_contract.catalog.streams import DRIVE_STREAM, VIDEO_STREAM
from iort_contract.messages.batch import Batch
from iort_contract.messages.files import File, file_key
from iort_contract.messages.recorder import KEPT, UPLOADED, Incident
from iort_contract.topics import RECORD, build_topic
from iort_station.cli.main import app
from iort_station.cli.options import CloudOptions
from iort_station.data.sight import sight
from iort_station.errors import StationError
from testkit.dynamodb import FILES, TELEMETRY, item_of
from tests.archived import FakeS3, archive, compact, expire
from tests.images import jpeg
from tests.unit.station.fleet.test_recorder import START, Lab, S

MS = 1_000
RUN, NEXT = "0badcafe", "1badcafe"
RANGE = ("--from", "2023-11-14T22:13:20Z", "--to", "2023-11-14T22:14:20Z")


class Seeing(Lab):
    """A cloud with a car that drove by sight."""

    def __init__(self) -> None:
        super().__init__()
        self._seq = 0

    def batch(self, stream: str, samples: dict[int, dict[str, Any]], run: str = RUN) -> None:
        names = dict.fromkeys(name for sample in samples.values() for name in sample)
        columns = {name: [sample.get(name) for sample in samples.values()] for name in names}
        self._seq += 1
        batch = Batch(run, self._seq, [START + t for t in samples], columns)
        self.table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car", stream)))

    def pictures(self, times: dict[int, int], run: str = RUN) -> None:
        """Pictures by their numbers, and when each was captured, in microseconds after `START`."""
        self.batch(VIDEO_STREAM, {t: {"frame": number, "bytes": 9_000} for number, t in times.items()}, run)

    def drove(self, t: int, run: str = RUN, **changes: Any) -> None:
        sample = {
            "session": "a1a1a1a1",
            "by": "ada",
            "seq": 7,
            "sent_us": START,
            "outcome": "accepted",
            "driver": "a1a1a1a1",
            "driver_by": "ada",
            "lease_left_ms": 300,
            "speed": 0.5,
            "steering": 0.1,
            "frame": None,
            "frame_age_ms": None,
            "blind": False,
        }
        self.batch(DRIVE_STREAM, {t: {**sample, **changes}}, run)


@pytest.fixture
def lab():
    lab = Seeing()
    lab.pictures({1: 0, 2: 66 * MS, 3: 133 * MS})
    lab.drove(100 * MS, frame=1, frame_age_ms=100.0)
    lab.drove(180 * MS, frame=3, frame_age_ms=47.0, seq=8)
    lab.drove(700 * MS, frame=3, frame_age_ms=567.0, seq=9, outcome="picture_late", speed=None, steering=None)
    lab.drove(750 * MS, frame=3, frame_age_ms=617.0, seq=10, lease_left_ms=0, speed=0.0)
    lab.drove(760 * MS, frame=3, frame_age_ms=617.0, seq=10, outcome="stopped", lease_left_ms=0)
    return lab


@pytest.fixture
def iort(lab, monkeypatch):
    monkeypatch.setattr(CloudOptions, "cloud", lambda _self: lab)
    return lambda *words: CliRunner().invoke(app, words, env={"COLUMNS": "160"})


def told(commands: Any) -> list[tuple[Any, ...]]:
    return [
        (one.outcome, one.frame, None if one.captured_us is None else one.captured_us - START, one.age_ms)
        for one in commands
    ]


def test_each_command_has_the_picture_that_it_names(lab: Seeing) -> None:
    found = sight(lab, "car")  # type: ignore[arg-type]  # a fake
    assert told(found.commands) == [
        ("accepted", 1, 0, 100.0),
        ("accepted", 3, 133 * MS, 47.0),
        ("picture_late", 3, 133 * MS, 567.0),
        ("accepted", 3, 133 * MS, 617.0),
    ]
    assert [(one.by, one.seq, one.speed, one.ends, one.by_sight) for one in found.commands] == [
        ("ada", 7, 0.5, False, True),
        ("ada", 8, 0.5, False, True),
        ("ada", 9, None, False, False),
        # It gave the car up, for which no picture is needed.
        ("ada", 10, 0.0, True, False),
    ]
    assert found.figures() == {
        "commands": 4,
        "with_picture": 4,
        "by_sight": 2,
        "blind": 0,
        "ends": 1,
        "age_p50_ms": 73.5,
        "age_p95_ms": 97.3,
        "age_longest_ms": 100.0,
        "picture_late": 1,
        "no_picture": 0,
        "not_recorded": 0,
    }


def test_numbers_begin_anew_in_each_run(lab: Seeing) -> None:
    lab.pictures({1: 5_000 * MS, 2: 5_066 * MS}, NEXT)
    lab.drove(5_100 * MS, NEXT, frame=1, frame_age_ms=100.0)
    lab.drove(5_150 * MS, NEXT, frame=3, outcome="picture_late")
    lab.drove(5_200 * MS, NEXT, frame=1, blind=True, frame_age_ms=200.0)
    found = sight(lab, "car", START + S)  # type: ignore[arg-type]  # a fake
    assert told(found.commands) == [
        ("accepted", 1, 5_000 * MS, 100.0),
        # A picture of the run before: this one has no third yet.
        ("picture_late", 3, None, None),
        ("accepted", 1, 5_000 * MS, 200.0),
    ]
    figures = found.figures()
    assert (figures["not_recorded"], figures["blind"], figures["by_sight"]) == (1, 1, 1)
    assert figures["age_longest_ms"] == 100.0, "nobody saw what a blind command names"


def test_a_range_finds_pictures_from_before_it(lab: Seeing) -> None:
    lab.pictures({4: 9_000 * MS})
    lab.drove(9_400 * MS, frame=4, frame_age_ms=400.0)
    found = sight(lab, "car", START + 9_300 * MS, START + 9_401 * MS)  # type: ignore[arg-type]  # a fake
    assert told(found.commands) == [("accepted", 4, 9_000 * MS, 400.0)]
    assert not sight(lab, "car", START + 9_300 * MS, START + 9_400 * MS).commands  # type: ignore[arg-type]  # a fake


def test_the_archive_and_the_table_tell_the_same(lab: Seeing) -> None:
    lab.bucket = FakeS3()
    before = sight(lab, "car")  # type: ignore[arg-type]  # a fake
    archive(lab.table, lab.bucket)
    expire(lab.table)
    assert sight(lab, "car") == before  # type: ignore[arg-type]  # a fake
    compact(lab.table, lab.bucket)
    assert sight(lab, "car") == before  # type: ignore[arg-type]  # a fake


def test_a_batch_that_cannot_be_read_is_counted_and_hides_no_other(lab: Seeing, iort: Any) -> None:
    lab.drove(300 * MS, frame=3)
    key = max(key for key in lab.table.items[TELEMETRY] if key[0] == build_topic(RECORD, "car", DRIVE_STREAM))
    lab.table.put(TELEMETRY, {**lab.table.items[TELEMETRY][key], "samples": {"B": b"nonsense"}})
    assert (sight(lab, "car").refused, len(sight(lab, "car").commands)) == (1, 5)  # type: ignore[arg-type]  # a fake
    assert "1 stored items cannot be read and are left out" in iort("sight", "car", *RANGE).stderr


def test_a_robot_that_was_never_driven(lab: Seeing, iort: Any) -> None:
    with pytest.raises(StationError, match="van has no stream drive"):
        sight(lab, "van")  # type: ignore[arg-type]  # a fake
    assert "car9 is not registered" in str(iort("sight", "car9").exception)
    done = iort("sight", "car", "--from", "2026-01-01T00:00:00Z", "--to", "2026-01-02T00:00:00Z")
    assert done.exit_code == 0
    assert "no motion commands in this range; car has drive from 2023-11-14T22:13:20.100000Z" in done.stderr


def test_a_table_and_its_summary(lab: Seeing, iort: Any) -> None:
    lab.drove(800 * MS, blind=True, by=None)
    lab.drove(850 * MS, outcome="no_picture", speed=None, steering=None)
    done = iort("sight", "car", *RANGE)
    assert done.exit_code == 0, done.output
    rows = [line.split() for line in done.stdout.splitlines()]
    assert rows[0] == [
        "time",
        "(UTC)",
        "by",
        "outcome",
        "picture",
        "captured",
        *["age", "ms", "blind", "speed", "steering"],
    ]
    assert rows[3][2:] == ["ada", "accepted", "3", "22:13:20.133", "47.0", "-", "0.5", "0.1"]
    assert rows[5][2:6] == ["ada", "accepted,", "ends", "3"]
    assert rows[6][2:] == ["-", "accepted", "-", "-", "-", "blind", "0.5", "0.1"]
    assert done.stdout.splitlines()[-3:] == [
        "6 commands; 4 name a picture (66.7 %); blind 1",
        "2 taken by sight; the picture's age: p50 73.5 ms, p95 97.3 ms, longest 100.0 ms",
        "refused: 1 by a late picture, 1 without a picture",
    ]
    answer = json.loads(iort("sight", "car", *RANGE, "--json").stdout)
    assert answer["summary"]["commands"] == len(answer["commands"]) == 6
    first = answer["commands"][0]
    assert (first["t"], first["captured"]) == ("2023-11-14T22:13:20.100000Z", "2023-11-14T22:13:20.000000Z")
    assert (first["run"], first["frame"], first["age_ms"], first["blind"]) == (RUN, 1, 100.0, False)


STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_JAZZY)}
COMPRESSED, RAW = "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image"


def image_file(ros: int, kind: str, pictures: dict[int, bytes]) -> bytes:
    """An incident's file with pictures, by their capture times."""
    store, out = STORES[ros], io.BytesIO()
    types, writer = store.types, Writer(out)
    writer.start("", "test")
    named = kind if ros == 2 else kind.replace("/msg", "")
    text = store.generate_msgdef(kind, ros_version=ros)[0].encode()
    schema = writer.register_schema(named, f"ros{ros}msg", text)
    channel = writer.register_channel("/iort/video", "cdr" if ros == 2 else "ros1", schema)
    other = writer.register_channel("vesc", "json", writer.register_schema("vesc", "jsonschema", b"{}"))
    for i, (t_us, data) in enumerate(pictures.items()):
        stamp = types["builtin_interfaces/msg/Time"](sec=t_us // S, nanosec=t_us % S * 1000)
        sequence = {} if ros == 2 else {"seq": i}
        header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="7", **sequence)
        fields: dict[str, Any] = {"format": "jpeg"}
        if kind == RAW:
            fields = {"height": 2, "width": 2, "encoding": "mono8", "is_bigendian": 0, "step": 2}
        content = types[kind](header=header, **fields, data=np.frombuffer(data, np.uint8))
        raw = store.serialize_cdr(content, kind) if ros == 2 else store.serialize_ros1(content, kind)
        # The ring's clock is another one.
        writer.add_message(channel, (t_us + 7 * S) * 1000, bytes(raw), t_us * 1000, i)
        writer.add_message(other, (t_us + 7 * S) * 1000, b"{}", t_us * 1000, i)
    writer.finish()
    return out.getvalue()


@pytest.fixture
def keep(lab, s3):
    lab.bucket = s3
    numbers = iter(range(1, 99))

    def keep(content: bytes, state: str = UPLOADED) -> None:
        number, digest = next(numbers), hashlib.sha256(content).hexdigest()
        file = File(f"brake-{number}.mcap", "recording", "application/x-mcap", len(content), digest, START)
        key = file_key("car", file)
        s3.put_object(Bucket=FILES, Key=key, Body=content, Metadata={"sha256": digest})
        about = Incident(
            f"{number:08x}", "brake", START - S, START + 40 * S, state, key=key, bytes=len(content)
        )
        lab.tell(about, START + 41 * S)

    return keep


def kept_file(ros: int, pictures: dict[int, bytes]) -> bytes:
    """An incident's file with the pictures that an agent keeps itself, by their capture times."""
    out, kind = io.BytesIO(), compressed_image(ros)
    writer, nothing = Writer(out), cast("Any", None)
    writer.start("", "test")
    schema = writer.register_schema(kind.name, f"ros{ros}msg", kind.definition.encode())
    channel = writer.register_channel(kind.topic, "cdr" if ros == 2 else "ros1", schema)
    for i, (t_us, data) in enumerate(pictures.items()):
        raw = message(Frame(i, t_us, 0.0, nothing), data, ros)
        writer.add_message(channel, (t_us + 7 * S) * 1000, raw, t_us * 1000, i)
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize("ros", [1, 2])
def test_the_pictures_that_an_agent_keeps_are_read(
    lab: Seeing, iort: Any, keep: Any, tmp_path: Any, ros: int
) -> None:
    there = {START + t: jpeg(t, width=32, height=24) for t in (0, 133 * MS)}
    keep(kept_file(ros, there))
    assert iort("sight", "car", *RANGE, "--pictures", str(tmp_path)).exit_code == 0
    assert [(tmp_path / f"{number}.jpg").read_bytes() for number in (1, 3)] == list(there.values())


@pytest.mark.parametrize("ros", [1, 2])
def test_the_pictures_of_incidents_are_written_by_their_numbers(
    lab: Seeing, iort: Any, keep: Any, tmp_path: Any, ros: int
) -> None:
    lab.pictures({40: 2 * S})
    lab.drove(2_100 * MS, frame=40, frame_age_ms=100.0)
    there = {START + t: jpeg(t, width=32, height=24) for t in (0, 66 * MS, 133 * MS)}
    keep(image_file(ros, COMPRESSED, {**there, START + 150 * MS: b"damaged"}))
    # It has nothing new; and what is no file stops nothing.
    keep(image_file(ros, COMPRESSED, {START: jpeg(7)}))
    keep(b"no file")
    keep(b"", KEPT)
    done = iort("sight", "car", *RANGE, "--pictures", str(tmp_path / "seen"))
    assert done.exit_code == 0, done.output
    # The second one is named by no command, and no incident has the fortieth.
    assert sorted(path.name for path in (tmp_path / "seen").iterdir()) == ["1.jpg", "3.jpg"]
    assert (tmp_path / "seen" / "1.jpg").read_bytes() == there[START]
    assert "2 of the 3 pictures" in done.stderr
    assert "brake-3.mcap" in done.stderr
    again = iort("sight", "car", *RANGE, "--pictures", str(tmp_path / "seen"))
    assert "exists" in str(again.exception)
    assert iort("sight", "car", *RANGE, "--pictures", str(tmp_path / "seen"), "--force").exit_code == 0


def test_pictures_of_two_runs_and_of_a_cameras_pixels(
    lab: Seeing, iort: Any, keep: Any, tmp_path: Any
) -> None:
    lab.pictures({1: 5 * S}, NEXT)
    lab.drove(5_100 * MS, NEXT, frame=1, frame_age_ms=100.0)
    keep(image_file(2, RAW, {START: b"\0\1\2\3", START + 5 * S: b"\4\5\6\7", START + 133 * MS: b"\0"}))
    done = iort("sight", "car", *RANGE, "--pictures", str(tmp_path), "--json")
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{RUN}-1.png", f"{NEXT}-1.png"]
    with Image.open(tmp_path / f"{NEXT}-1.png") as image:
        assert image.convert("L").tobytes() == b"\4\5\6\7"
    assert json.loads(done.stdout)["pictures"]["written"] == 2
    # One that is cut short is told, and stops no other.
    assert "2023-11-14T22:13:20.133000Z" in done.stderr
