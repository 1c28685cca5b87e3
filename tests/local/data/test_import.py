"""Recordings are imported as if the robot had driven: whole, once, with their own times; or refused."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from iort_contract.archive import HOUR, JOIN, TASK, ArchiveTable, parse_hour
from iort_contract.catalog.streams import ACCOUNT_STREAM
from iort_contract.dynamodb import starting_between
from iort_contract.recordings.rosbag import Recording, Unread
from iort_contract.recordings.scan import Scan
from iort_contract.ros.message import RosMessage
from iort_contract.tables import DEFAULT_RETENTION_DAYS, EXPIRES_S, RECEIVED_MS, TOPIC
from iort_station import data
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.cloud import invoke as invoke_function
from iort_station.data.recorded import Recorded, archive_of, telemetry_table, topic_of
from iort_station.fleet import robots
from iort_station.imports.choice import Choice
from iort_station.imports.ledger import Ledger
from iort_station.imports.plan import check, look
from iort_station.imports.run import run
from iort_station.operations import archive, audit
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from testkit.bags import START_NS, STREAMS, TOPICS, speed, voltage, written
from testkit.waiting import GUARD_S, until
from tests.local.conftest import invoke
from tests.recordings import recording

SECONDS = 4.0
COUNTS = {STREAMS[topic.name]: int(SECONDS * topic.hz) for topic in TOPICS}
Iort = Callable[..., Any]
DAY_NS = 86_400_000_000_000


@pytest.fixture
def importer(embedded: EmbeddedCloud, tmp_path: Path, request: pytest.FixtureRequest) -> tuple[str, Iort]:
    """A robot, and the command of somebody who has only the rights that docs/how-to/import.md lists."""
    name = f"i{abs(hash(request.node.name)):x}"[:20]
    robots.add(embedded.cloud, name, out=tmp_path)
    iam, user = embedded.cloud.client("iam"), f"importer-{name}"
    iam.create_user(UserName=user)
    policy = (ROOT / "docs/examples/import.json").read_text()
    iam.put_user_policy(UserName=user, PolicyName="import", PolicyDocument=policy)
    key = iam.create_access_key(UserName=user)["AccessKey"]
    folder = tmp_path / "importer"
    folder.mkdir()
    whose = {"access_key_id": key["AccessKeyId"], "secret_access_key": key["SecretAccessKey"]}
    replace(embedded.cloud, **whose).save(folder / EMBEDDED.name)

    def iort(*arguments: object, status: int = 0) -> Any:
        done = invoke(folder, *map(str, arguments))
        assert done.exit_code == status, (done.output, done.exception)
        return done

    return name, iort


# No two tests have the same recording, which is of one robot.
_DAYS = count()


def fresh_ns() -> int:
    """The time of a drive that no other test has."""
    return START_NS + next(_DAYS) * DAY_NS


def made(folder: Path, kind: str, *, seconds: float = SECONDS, start_ns: int | None = None) -> Path:
    """A recording of one of the kinds."""
    start_ns = fresh_ns() if start_ns is None else start_ns
    path = folder / {"bag": "drive.bag", "mcap of ROS 1": "drive.mcap"}.get(kind, "drive")
    written(path, kind, seconds=seconds, start_ns=start_ns)
    return path


def messages(path: Path, scan: Scan | None = None) -> dict[str, list[tuple[int, bytes]]]:
    """A recording's messages by stream: time in microseconds, and bytes."""
    found: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with Recording(path, tuple(STREAMS.items()), "vesc", Unread(), reader=scan) as read:
        for one in read:
            if one.stream in COUNTS:
                assert isinstance(one.values, RosMessage)
                found[one.stream].append((one.stamp_ns // 1000, one.values.raw))
    return {stream: sorted(some) for stream, some in found.items()}


def exported(cloud: Cloud, robot: str, folder: Path, file: str) -> dict[str, list[tuple[int, bytes]]]:
    """What the robot has, by an export into a bag of ROS 1 or a folder of ROS 2."""
    cloud.save(folder / EMBEDDED.name)
    done = invoke(folder, "export", robot, "--last", "all", "--out", str(folder / file), "--force")
    assert done.exit_code == 0, done.output
    return messages(folder / file)


def audited(cloud: Cloud, robot: str, streams: Any = COUNTS) -> dict[str, audit.Audit]:
    return {one: audit.audit(one, audit.headers(cloud, robot, one), from_start=True) for one in streams}


def whole(cloud: Cloud, robot: str, folder: Path, path: Path, scan: Scan | None = None) -> None:
    """Everything of a recording is there, once, and as it was."""
    of_streams = audited(cloud, robot)
    assert all(one.complete for one in of_streams.values())
    assert {stream: sum(one.samples for one in each.runs) for stream, each in of_streams.items()} == COUNTS
    ros1 = scan is not None or path.suffix == ".bag"
    found, of_file = exported(cloud, robot, folder, "out.bag" if ros1 else "out"), messages(path, scan)
    assert {stream: [raw for _, raw in some] for stream, some in found.items()} == {
        stream: [raw for _, raw in some] for stream, some in of_file.items()
    }
    vesc = data.query(cloud, robot, "vesc", fields=["speed", "voltage_input"])
    assert vesc.times_us.tolist() == [t_us for t_us, _ in of_file["vesc"]]
    assert vesc.columns["speed"].tolist() == [speed(i) for i in range(COUNTS["vesc"])]
    assert vesc.columns["voltage_input"].tolist() == [voltage(i) for i in range(COUNTS["vesc"])]


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3", "mcap of ROS 1"])
def test_an_old_drive_goes_into_the_archive(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path, kind: str
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    path = made(tmp_path, kind)
    planned = json.loads(iort("import", path, robot, "--dry-run", "--json").stdout)
    (one,) = planned["recordings"]
    assert (one["streams"], one["store"], one["refused"]) == (COUNTS, "archive", "")
    assert planned["cost"]["once_usd"] > 0 < planned["cost"]["storage_usd"]
    assert not audited(cloud, robot)["vesc"].runs, "a dry run imports nothing"

    (one,) = json.loads(iort("import", path, robot, "--json").stdout)["recordings"]
    assert {stream: one["stored"][stream] for stream in COUNTS} == COUNTS
    scan = Scan(path) if kind == "mcap of ROS 1" else None
    whole(cloud, robot, tmp_path, path, scan)
    assert not next(telemetry_table(cloud).pages(topic_of(cloud, robot, "vesc"))).items
    assert iort_of(embedded, "audit", robot).exit_code == 0
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0

    # A second import does nothing, whatever the file is called.
    copy = tmp_path / f"other{path.suffix}"
    (shutil.copytree if path.is_dir() else shutil.copyfile)(path, copy)
    again = iort("import", copy, robot).output
    assert "nothing to do" in again
    whole(cloud, robot, tmp_path, path, scan)


def iort_of(embedded: EmbeddedCloud, *arguments: str) -> Any:
    return invoke(embedded.folder, *arguments)


def test_a_recent_drive_goes_into_the_table(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    start_ns = time.time_ns() - 3 * DAY_NS
    path = made(tmp_path, "mcap", start_ns=start_ns)
    iort("import", path, robot)
    whole(cloud, robot, tmp_path, path)
    (page, *_) = telemetry_table(cloud).pages(topic_of(cloud, robot, "vesc"))
    # As the rule would have stored it when it was recorded.
    first = page.items[0]
    received_s = int(first[RECEIVED_MS]["N"]) // 1000
    assert abs(received_s - start_ns // 10**9) <= 2
    assert int(first[EXPIRES_S]["N"]) == received_s + DEFAULT_RETENTION_DAYS * 86_400

    def summarized() -> bool:
        return all(audit.samples_summarized(cloud, robot, one) == number for one, number in COUNTS.items())

    until(summarized, "every sample is in its second")
    archive.run(cloud, topic_of(cloud, robot, "vesc"))
    archive.wait(cloud, lambda _left: None)
    whole(cloud, robot, tmp_path, path)


def test_the_archive_joins_imported_hours_to_their_day(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    edge_ns = -(-fresh_ns() // 3_600_000_000_000) * 3_600_000_000_000
    path = made(tmp_path, "mcap", start_ns=edge_ns - 2_000_000_000)
    iort("import", path, robot)
    whole(cloud, robot, tmp_path, path)
    rows = list(archive_of(cloud, topic_of(cloud, robot, "vesc")).rows())
    assert [row.key[-10:] for row in rows] == ["12.parquet", "13.parquet"]
    for stream in COUNTS:
        task = {TASK: JOIN, TOPIC: topic_of(cloud, robot, stream), HOUR: rows[0].hour[:10]}
        invoke_function(cloud, "archive", "ArchiveFunction", json.dumps(task).encode(), "the archive")
    rows = list(archive_of(cloud, topic_of(cloud, robot, "vesc")).rows())
    assert {row.key[-11:] for row in rows} == {"day.parquet"}
    whole(cloud, robot, tmp_path, path)
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0


def test_an_interrupted_import_goes_on(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    """The first of two recordings is imported, and the second one in part."""
    (robot, iort), cloud = importer, embedded.cloud
    paths = []
    for name in ("a", "b"):
        (folder := tmp_path / name).mkdir()
        paths.append(made(folder, "bag"))
    plans = look(paths, Choice(), start_us=None)
    check(cloud, robot, plans, archive=True, overlap=False, retention_s=86_400)
    told: list[int] = []

    def stop(more: int) -> None:
        told.append(more)
        if len(told) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(cloud, robot, plans, retention_s=86_400, units_per_s=500, progress=stop)
    first, second = json.loads(iort("import", *paths, robot, "--dry-run", "--json").stdout)["recordings"]
    assert "imported on" in first["there"]
    assert (second["begun"], second["there"]) == (True, "")
    iort("import", *paths, robot)
    for stream, one in audited(cloud, robot).items():
        assert one.complete
        assert [each.samples for each in one.runs] == [COUNTS[stream]] * 2
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0


def test_a_killed_import_into_the_table_goes_on(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    path = made(tmp_path, "mcap", start_ns=time.time_ns() - DAY_NS)
    where = ["--local", "--embedded", str(tmp_path / "importer" / EMBEDDED.name)]
    command = [Path(sys.executable).parent / "iort", *where, "import", path, robot, "--units", "200"]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    topic = topic_of(cloud, robot, "scan")

    def some() -> bool:
        return bool(next(telemetry_table(cloud).pages(topic)).items) or process.poll() is not None

    until(some, "a batch of the import, or its end")
    process.send_signal(signal.SIGKILL)
    process.wait()
    iort("import", path, robot)
    whole(cloud, robot, tmp_path, path)


def test_a_full_disk_is_named_and_the_import_goes_on(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    robot, iort = importer
    path = made(tmp_path, "bag")
    where = ["--local", "--embedded", str(tmp_path / "importer" / EMBEDDED.name)]
    command = [str(Path(sys.executable).parent / "iort"), *where, "import", str(path), robot]

    def small() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))

    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=small, check=False)
    assert done.returncode == 1
    assert "make room" in done.stderr
    assert "it goes on" in done.stderr
    iort("import", path, robot)
    whole(embedded.cloud, robot, tmp_path, path)


def test_parts_of_a_drive_share_an_hour(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    """Imported together, and one after the other, later ones first; and one among the others."""
    (robot, iort), cloud = importer, embedded.cloud
    paths, start_ns = [], fresh_ns()
    for part in range(4):
        (folder := tmp_path / str(part)).mkdir()
        paths.append(made(folder, "bag", start_ns=start_ns + part * 10_000_000_000))
    iort("import", paths[3], robot)
    iort("import", paths[0], paths[1], robot)
    iort("import", tmp_path / "2", robot)
    of_vesc = audited(cloud, robot)["vesc"]
    assert of_vesc.complete
    assert len(of_vesc.runs) == 4
    found = data.query(cloud, robot, "vesc", fields=["speed"])
    assert found.columns["speed"].tolist() == [speed(i) for i in range(COUNTS["vesc"])] * 4
    # Another recording of the same time is refused, and then laid among these.
    (folder := tmp_path / "5").mkdir()
    among = made(folder, "mcap", start_ns=start_ns + 2_000_000_000, seconds=30.0)
    assert "has imu-data of this time already" in iort("import", among, robot, status=1).output
    iort("import", among, robot, "--overlap")
    times = data.query(cloud, robot, "vesc", fields=["speed"]).times_us.tolist()
    assert len(times) == 4 * COUNTS["vesc"] + 1500
    assert times == sorted(times)
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0
    assert audited(cloud, robot)["vesc"].complete


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_what_was_cut_off_is_imported_up_to_where_it_is_good(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path, kind: str
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    path = made(tmp_path, kind)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    (cut := tmp_path / f"cut{file.suffix}").write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.7)])
    done = iort("import", cut, robot)
    assert "imported up to where it is good" in done.output
    (scan := Scan(cut)).open()
    of_file = messages(cut, scan)
    for stream, some in of_file.items():
        assert len(data.query(cloud, robot, stream).times_us) == len(some) > 0
        assert audited(cloud, robot, [stream])[stream].complete
    assert lost(cloud, robot) == {f"{cut.name}.unread": 1}
    assert "nothing to do" in iort("import", cut, robot).output
    # The whole one has what is there already.
    assert "of this time already" in iort("import", path, robot, status=1).output


def test_an_import_is_refused_with_what_to_do(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    other = f"{robot}-b"
    robots.add(cloud, other, out=tmp_path)
    start_ns = fresh_ns()
    path = made(tmp_path, "bag", start_ns=start_ns)
    (twin := tmp_path / "twin").mkdir()
    again = made(twin, "mcap of ROS 1", start_ns=start_ns)
    iort_of(embedded, "robots", "list")
    assert "is not registered" in str(iort("import", path, f"{robot}x", status=1).exception)
    assert "overlaps" in iort("import", path, again, robot, status=1).output
    done = iort("import", path, other, status=1)
    assert f"is imported for {robot} already" in done.output
    assert "its imu-data" in iort("import", path, robot, "--start", "2021-01-01T00:00Z", status=1).output
    for name, content, problem in (
        ("empty.bag", b"", "is empty: was it copied whole?"),
        ("none.mcap", b"no recording, but a text", "is no recording by its first bytes"),
        ("none.csv", b"no;log", "is no VESC Tool log"),
        ("wrong.bag", again.read_bytes(), "is MCAP by its content: rename it to wrong.mcap"),
    ):
        (file := tmp_path / name).write_bytes(content)
        assert problem in iort("import", file, robot, status=1).output.replace("\n", "")
    assert "no such file or folder" in str(iort("import", tmp_path / "absent.bag", robot, status=1).exception)
    (nothing := tmp_path / "nothing").mkdir()
    assert "has no recording" in str(iort("import", nothing, robot, status=1).exception)


def test_a_clock_that_was_not_set_needs_a_time(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    path = made(tmp_path, "bag", start_ns=12_000_000_000)
    assert (
        "its clock was not set: it begins at 1970-01-01T00:00:12"
        in iort("import", path, robot, status=1).output
    )
    iort("import", path, robot, "--start", "2021-05-04T10:00:00Z")
    found = data.query(cloud, robot, "vesc", fields=["speed"])
    assert found.columns["speed"].tolist() == [speed(i) for i in range(COUNTS["vesc"])]
    # Its header is 2 ms older than the time of recording.
    assert found.times_us[0] == 1_620_122_400_000_000 - 2_000


def test_an_incident_of_another_robot_is_refused(importer: tuple[str, Iort], tmp_path: Path) -> None:
    robot, iort = importer
    written(source := tmp_path / "a.mcap", "mcap of ROS 1", seconds=1.0, start_ns=fresh_ns())
    scan = Scan(source)
    scan.open()
    with (path := tmp_path / "incident.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1")
        known = {}
        for found, t_ns, raw in scan.messages(lambda _: True):
            if found not in known:
                schema = writer.register_schema(found.msgtype, "ros1msg", found.msgdef.encode())
                known[found] = writer.register_channel(found.topic, "ros1", schema, {"md5sum": found.digest})
            writer.add_message(known[found], t_ns, raw, t_ns)
        writer.add_metadata("incident", {"agent": json.dumps({"robot": "car3"})})
        writer.finish()
    assert "says that it is car3's" in iort("import", path, robot, status=1).output
    assert "imported 301" in iort("import", path, robot, "--overlap").output.replace(",", "")


def test_a_configuration_chooses_as_the_agent_does(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    start_ns = fresh_ns()
    path = made(tmp_path, "mcap", start_ns=start_ns)
    topics = {
        "/odom": {"stream": "pose", "time": "header", "fields": ["pose.pose.position"]},
        "/imu/*": {"time": "arrival"},
        "/scan": {"stream": "scan", "time": "header", "only": "ring"},
    }
    car = {"robot": robot, "sources": [{"type": "ros2", "topics": topics}]}
    (config := tmp_path / "car.yaml").write_text(yaml.safe_dump(car))
    (one,) = json.loads(iort("import", path, robot, "--config", config, "--json").stdout)["recordings"]
    assert one["streams"] == {"imu-data": COUNTS["imu-data"], "pose": COUNTS["odom"]}
    assert set(data.query(cloud, robot, "pose").columns) == {f"pose.pose.position.{axis}" for axis in "xyz"}
    times = data.query(cloud, robot, "imu-data").times_us
    assert times[0] == start_ns // 1000, "by arrival, and not by the header"
    config.write_text(yaml.safe_dump({**car, "robot": "car3"}))
    assert "is the configuration of car3" in str(
        iort("import", path, robot, "--config", config, status=1).exception
    )
    iort("import", path, robot, "--topic", "/tf")
    assert len(data.query(cloud, robot, "tf").times_us) == COUNTS["tf"]


def test_the_recordings_of_real_cars(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    bag, log = recording("f1tenth-motor-servo.bag"), recording("vesc-tool-ride.csv")
    iort("import", bag, robot, "--topic", "/sensors/core")
    named = tmp_path / "2024-06-12_00-34-31.csv"
    shutil.copyfile(log, named)
    iort("import", named, robot, "--archive")
    of_vesc = audited(cloud, robot, ["vesc"])["vesc"]
    assert of_vesc.complete
    counts = [run_.samples for run_ in of_vesc.runs]
    assert sorted(counts) == sorted([2244, len(named.read_text().splitlines()) - 1])
    assert iort_of(embedded, "audit", robot).exit_code == 0
    first = next(iter(Recorded(cloud, robot, "vesc").items(starting_between(None, None))))
    assert first


def test_large_arrays_become_files(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    (robot, iort), cloud = importer, embedded.cloud
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    path, kind = tmp_path / "camera.bag", "sensor_msgs/msg/CompressedImage"
    images = [b"\xff\xd8\xff" + os.urandom(300_000) for _ in range(4)]
    with Writer(path) as writer:
        connection = writer.add_connection("/camera", kind, typestore=store)
        for i, image in enumerate(images):
            at_ns = START_NS + i * 500_000_000
            stamp = types["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
            header = types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="")
            message = types[kind](header=header, format="jpeg", data=np.frombuffer(image, dtype=np.uint8))
            writer.write(connection, at_ns, store.serialize_ros1(message, kind))
    assert "camera: 4 messages are larger than a robot can send" in iort("import", path, robot).output
    other = f"{robot}-b"
    robots.add(cloud, other, out=tmp_path)
    (one,) = json.loads(iort("import", path, other, "--large", "upload", "--overlap", "--json").stdout)[
        "recordings"
    ]
    assert (one["files"], one["stored"]["camera"], one["too_large"]) == (2, 4, {})
    found = data.query(cloud, other, "camera", fields=["data.key", "data.size"])
    keys = found.columns["data.key"].tolist()
    assert [key is not None for key in keys] == [True, False, True, False]
    client, bucket = cloud.client("s3"), cloud.output("storage", "FilesBucket")
    assert client.get_object(Bucket=bucket, Key=keys[2])["Body"].read() == images[2]


def lost(cloud: Cloud, robot: str) -> dict[str, int]:
    """What the runs' accounts say that was not imported."""
    found = data.query(cloud, robot, ACCOUNT_STREAM).columns.get("counts", np.array([]))
    return {path: count for text in found if text for path, count in json.loads(text).items()}


def test_an_import_that_was_killed_before_the_row_goes_on(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    """The hour was there already: its object has the import's batches, and its row does not say so."""
    (robot, iort), cloud = importer, embedded.cloud
    paths, start_ns = [], fresh_ns()
    for part in range(2):
        (folder := tmp_path / str(part)).mkdir()
        paths.append(made(folder, "bag", start_ns=start_ns + part * 10_000_000_000))
    iort("import", paths[0], robot)
    manifest = ArchiveTable(cloud.client("dynamodb"), cloud.output("storage", "ArchiveTable"))
    topics = [topic_of(cloud, robot, stream) for stream in COUNTS]
    before = [row for topic in topics for row in archive_of(cloud, topic).rows()]
    iort("import", paths[1], robot)
    after = [row for topic in topics for row in archive_of(cloud, topic).rows()]
    for old, new in zip(before, after, strict=True):
        assert old.content != new.content
        manifest.keep(old, new)
    ledger = Ledger(cloud)
    (plan,) = look(paths[1:], Choice(), start_us=None)
    (note,) = ledger.of(plan.content)
    ledger.note(plan.content, replace(note, done_ms=0))
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 1

    iort("import", paths[1], robot)
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0
    for stream, one in audited(cloud, robot).items():
        assert one.complete
        assert [each.samples for each in one.runs] == [COUNTS[stream]] * 2

    # An object that says something else is not taken for this.
    for old, new in zip(before, after, strict=True):
        manifest.keep(replace(old, content="0" * 64), manifest.row(new.topic, parse_hour(new.hour)))
    ledger.note(plan.content, replace(note, done_ms=0))
    assert "iort archive verify" in str(iort("import", paths[1], robot, status=1).exception)


HOLDS = {
    # Where an import is held: the other one then runs as far as its own hold, or to its end.
    "before it is under way": ("s3", "PutObject", r"imports/under-way/"),
    "before its note": ("s3", "PutObject", r"imports/[0-9a-f]{64}\.json"),
    "before its object": ("s3", "PutObject", r"archive/"),
    "before its row": ("dynamodb", "PutItem", r""),
}


def held(cloud: Cloud, where: str, act: Callable[[], None]) -> Cloud:
    """The cloud with clients of its own, which ``act`` once before the first such call."""
    own, (service, operation, key) = replace(cloud), HOLDS[where]
    acted: list[bool] = []

    def hold(params: dict[str, Any], **_other: Any) -> None:
        if not acted and (service != "s3" or re.match(key, params["Key"])):
            acted.append(True)
            act()

    own.client(service).meta.events.register(f"provide-client-params.{service}.{operation}", hold)
    return own


@pytest.mark.parametrize(
    ("first", "second", "same", "there"),
    [
        # The second one writes the hour's object from what it has read before the first one's row.
        ("before its row", "before its row", False, False),
        ("before its row", "before its row", False, True),
        ("before its row", "before its object", False, False),
        ("before its row", "", False, True),
        ("before its object", "before its row", False, True),
        ("before its object", "", False, False),
        ("before its row", "before its row", True, False),
        ("before its note", "", True, False),
        ("before it is under way", "", True, False),
        ("before it is under way", "", False, False),
    ],
)
def test_two_imports_at_once_lose_nothing(
    embedded: EmbeddedCloud,
    importer: tuple[str, Iort],
    tmp_path: Path,
    *,
    first: str,
    second: str,
    same: bool,
    there: bool,
) -> None:
    """The first is held while the second one runs, and the second one, if at all, until the first has ended;
    of the ``same`` recording, or into an hour that is ``there`` already."""
    (robot, iort), cloud = importer, embedded.cloud
    paths, start_ns = [], fresh_ns()
    for part in range(3):
        (folder := tmp_path / str(part)).mkdir()
        paths.append(made(folder, "bag", start_ns=start_ns + part * 10_000_000_000))
    if there:
        iort("import", paths[2], robot)
    given = (paths[0], paths[0 if same else 1])
    plans = [look([path], Choice(), start_us=None) for path in given]
    for some in plans:
        check(cloud, robot, some, archive=True, overlap=False, retention_s=86_400)
    goes, ended = threading.Event(), threading.Event()

    def import_second() -> None:
        try:
            run(other, robot, plans[1], retention_s=86_400, units_per_s=500)
        finally:
            goes.set()

    def wait() -> None:
        goes.set()
        assert ended.wait(GUARD_S)

    other = held(cloud, second, wait) if second else replace(cloud)
    with ThreadPoolExecutor(1) as pool:
        second_ends: list[Future[None]] = []

        def let_second_go() -> None:
            second_ends.append(pool.submit(import_second))
            assert goes.wait(GUARD_S)

        try:
            run(held(cloud, first, let_second_go), robot, plans[0], retention_s=86_400, units_per_s=500)
        finally:
            ended.set()
        second_ends[0].result(GUARD_S)

    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0
    for stream, one in audited(cloud, robot).items():
        assert one.complete
        assert [each.samples for each in one.runs] == [COUNTS[stream]] * (2 + there - same)
    assert "nothing to do" in iort("import", *given, robot).output


@pytest.mark.parametrize(
    ("first", "refused", "words"),
    [
        # The second one comes before the first one has stored anything, or before it has said that it will.
        ("before its object", 1, r"overlaps drive\.bag in .*vesc, whose import has begun: let it end"),
        ("before it is under way", 0, "has imu-data of this time already"),
    ],
)
def test_of_two_imports_of_the_same_time_at_once_one_is_refused(
    embedded: EmbeddedCloud,
    importer: tuple[str, Iort],
    tmp_path: Path,
    *,
    first: str,
    refused: int,
    words: str,
) -> None:
    (robot, iort), cloud, start_ns = importer, embedded.cloud, fresh_ns()
    paths = [made(tmp_path, kind, start_ns=start_ns) for kind in ("bag", "mcap")]
    plans = [look([path], Choice(), start_us=None) for path in paths]
    for some in plans:
        check(cloud, robot, some, archive=True, overlap=False, retention_s=86_400)
    outcomes: dict[int, list[Any]] = {}

    def import_(number: int, by: Cloud) -> None:
        outcomes[number] = run(by, robot, plans[number], retention_s=86_400, units_per_s=500)

    import_(0, held(cloud, first, lambda: import_(1, replace(cloud))))
    assert [len(outcomes[number]) for number in (0, 1)] == [int(number != refused) for number in (0, 1)]
    assert re.search(words, plans[refused][0].refused)
    for stream, one in audited(cloud, robot).items():
        assert one.complete
        assert [each.samples for each in one.runs] == [COUNTS[stream]]
    # What was refused stands in nobody's way.
    (late,) = plans[refused]
    assert "of this time already" in iort("import", late.path, robot, status=1).output
    iort("import", late.path, robot, "--overlap")
    assert iort_of(embedded, "archive", "verify", robot).exit_code == 0


def test_a_drive_on_the_border_of_the_retention_goes_into_the_archive(
    importer: tuple[str, Iort], tmp_path: Path
) -> None:
    """The table would delete its beginning before that is archived."""
    robot, iort = importer
    border_ns, path = time.time_ns() - DEFAULT_RETENTION_DAYS * DAY_NS, tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data")
        channel = writer.register_channel("/x", "cdr", schema)
        for day in (-1, 10):
            writer.add_message(channel, border_ns + day * DAY_NS, b"\0\1\0\0\7\0\0\0", 0)
        writer.finish()
    (one,) = json.loads(iort("import", path, robot, "--dry-run", "--json").stdout)["recordings"]
    assert one["store"] == "archive"


def test_more_topics_than_files_may_be_open(
    embedded: EmbeddedCloud, importer: tuple[str, Iort], tmp_path: Path
) -> None:
    """Also with names that nobody expects."""
    (robot, _), cloud = importer, embedded.cloud
    path, start_ns, topics = tmp_path / "drïve \udcff\n.mcap", fresh_ns(), 120
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", b"int32 data")
        for i in range(topics):
            channel = writer.register_channel(f"/t{i}", "cdr", schema)
            writer.add_message(channel, start_ns + i, b"\0\1\0\0" + i.to_bytes(4, "little"), 0)
        for topic in ("/a b", "", "/ä", "t0"):
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, start_ns, b"\0\1\0\0\0\0\0\0", 0)
        writer.finish()
    where = ["--local", "--embedded", str(tmp_path / "importer" / EMBEDDED.name)]
    command = [str(Path(sys.executable).parent / "iort"), *where, "import", str(path), robot]

    def few() -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))

    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=few, check=False)
    assert done.returncode == 0, done.stderr
    assert data.query(cloud, robot, "t119").columns["data"].tolist() == [119]
    assert data.query(cloud, robot, "t0").columns["data"].tolist() == [0]
