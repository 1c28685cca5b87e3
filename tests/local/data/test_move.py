"""Robots move from one embedded cloud into another: interrupted, gone on with, compared, and driving on."""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from functions.upload import Bucket, metadata
from iort_contract.cloud import IOT
from iort_contract.messages.batch import BatchId
from iort_contract.messages.files import PART_BYTES, File, file_key
from iort_contract.tables import (
    BATCH,
    BY_LATER,
    CONNECTED_MS,
    ENTRY,
    FIRST_MS,
    LAST_MS,
    PAYLOAD,
    PUT_OFF,
    SOURCE,
    TOPIC,
)
from iort_contract.tables import ROBOT as ROBOT_KEY
from iort_station import data
from iort_station.cloud import EMBEDDED, Cloud
from iort_station.data import findings
from iort_station.data.recorded import archive_of, telemetry_table, topic_of
from iort_station.errors import StationError
from iort_station.fleet import control, files, identity, registry, robots
from iort_station.migration import files as stored_files
from iort_station.migration import recordings
from iort_station.migration.files import base64_sha256
from iort_station.operations import archive, audit, quarantine
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from testkit.mqtt import Robot
from testkit.ports import free_port
from testkit.proxy import REFUSE, Proxy
from testkit.waiting import until
from tests.local.conftest import command, invoke
from tests.local.data.drives import Agent
from tests.local.data.test_archive import HOUR_US, START, stored

ROBOT, STREAM = "moving", "vesc"
VEHICLE = {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 1.5}


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedCloud]:
    ports = {name: free_port() for name in ("gateway", "mqtt")}
    with EmbeddedCloud(tmp_path_factory.mktemp("other") / "local", live=IOT, ports=ports) as cloud:
        yield cloud


class Side(NamedTuple):
    """A cloud as somebody sees it who has only the rights that docs/how-to/move.md lists."""

    folder: Path
    user: str


@pytest.fixture(scope="module")
def movers(
    embedded: EmbeddedCloud, other: EmbeddedCloud, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Side, Side]:
    """The source and the target."""
    folders = [tmp_path_factory.mktemp(name) for name in ("source", "target")]
    return limited(embedded, "source", folders[0]), limited(other, "target", folders[1])


def limited(side: EmbeddedCloud, name: str, folder: Path) -> Side:
    iam, user = side.cloud.client("iam"), f"mover-{name}"
    iam.create_user(UserName=user)
    policy = (ROOT / "docs/examples" / f"move-{name}.json").read_text()
    iam.put_user_policy(UserName=user, PolicyName="move", PolicyDocument=policy)
    key = iam.create_access_key(UserName=user)["AccessKey"]
    whose = {"access_key_id": key["AccessKeyId"], "secret_access_key": key["SecretAccessKey"]}
    replace(side.cloud, **whose).save(folder / EMBEDDED.name)
    return Side(folder, user)


def iort(cloud: EmbeddedCloud | Side, *arguments: str) -> Any:
    return invoke(cloud.folder, *arguments)


def upload(cloud: Cloud, content: bytes) -> str:
    """Store a file as a robot does."""
    sha256 = hashlib.sha256(content).hexdigest()
    file = File(f"{len(content)}.bag", "recording", "application/x-bag", len(content), sha256, START)
    key = file_key(ROBOT, file)
    bucket = Bucket(cloud.client("s3"), cloud.output("storage", "FilesBucket"))
    parts = [content[i : i + PART_BYTES] for i in range(0, len(content), PART_BYTES)]
    given = {"Bucket": cloud.output("storage", "FilesBucket"), "Key": key}
    if len(parts) == 1:
        told = {"ContentType": file.content_type, "Metadata": metadata(file)}
        told |= {"ChecksumSHA256": base64_sha256(content)}
        cloud.client("s3").put_object(**given, **told, Body=content)
        return key
    upload_id = bucket.begin(key, file)
    for number, part in enumerate(parts, 1):
        whose = {"UploadId": upload_id, "PartNumber": number, "ChecksumSHA256": base64_sha256(part)}
        cloud.client("s3").upload_part(**given, **whose, Body=part)
    bucket.complete(key, upload_id, bucket.parts(key, upload_id), len(content))
    return key


def test_a_robot_moves_with_everything_that_it_has_recorded(
    embedded: EmbeddedCloud,
    other: EmbeddedCloud,
    movers: tuple[Side, Side],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source, target = embedded.cloud, other.cloud
    robots.add(source, ROBOT, out=tmp_path / "source", vehicle=VEHICLE)
    items = stored(source, ROBOT)
    telemetry_table(source).put(items)
    archive.run(source, topic_of(source, ROBOT, STREAM))
    archive.wait(source, lambda _left: None)
    # The first hour is in the archive alone; of the second one the table has the end.
    for item in items[:40]:
        key = {name: item[name] for name in (TOPIC, BATCH)}
        source.client("dynamodb").delete_item(TableName=source.output("storage", "TelemetryTable"), Key=key)
    # A later hour is not archived yet.
    late = {**items[-1], BATCH: {"S": str(BatchId(START + 5 * HOUR_US, "0badcafe", 60))}}
    telemetry_table(source).put([late])
    large = bytes(PART_BYTES) + b"large"
    keys = upload(source, b"small"), upload(source, large)
    before = data.query(source, ROBOT, STREAM)
    assert len(before) == 61 * 50

    def moved(*options: str) -> tuple[int, dict[str, Any]]:
        done = iort(movers[0], "move", ROBOT, "--to", str(movers[1].folder), "--json", *options)
        told = {one["stream"]: one for one in json.loads(done.stdout)["streams"]}
        return done.exit_code, told[STREAM]

    exit_code, told = moved("--dry-run")
    assert (exit_code, told["problem"]) == (1, "the target lacks 61 of 61 batches: move again")

    # It is interrupted three times: before a bundle is written, before the table's batches, in a file.
    def broken(*_: Any) -> None:
        raise StationError("the network is gone")

    def hashed(content: bytes) -> str:
        if content == b"large":
            broken()
        return base64_sha256(content)

    bundles = ("--bundles", str(tmp_path / "new"))
    parts = (
        (robots, "write_bundle", broken),
        (recordings, "write", broken),
        (stored_files, "base64_sha256", hashed),
    )
    for module, name, instead in parts:
        with monkeypatch.context() as patch:
            patch.setattr(module, name, instead)
            done = iort(movers[0], "move", ROBOT, "--to", str(movers[1].folder), *bundles)
            assert (done.exit_code, str(done.exception)) == (1, "the network is gone")
    exit_code, told = moved(*bundles)
    assert (exit_code, told["problem"], told["copied_hours"], told["copied_batches"]) == (0, "", 0, 0)
    assert (told["batches"], told["samples"], told["missing"]) == (61, 61 * 50, 0)
    with Robot(tmp_path / "new" / ROBOT) as robot:
        robot.online()

    after = data.query(target, ROBOT, STREAM)
    assert after.times_us.tolist() == before.times_us.tolist()
    assert after.columns["speed"].tolist() == before.columns["speed"].tolist()
    assert [files.content(target, key) for key in keys] == [b"small", large]
    audits = [json.loads(iort(cloud, "audit", ROBOT, "--json").stdout) for cloud in (embedded, other)]
    assert audits[0]["streams"] == audits[1]["streams"] != []
    # A batch whose content is another one is found, though the counts agree.
    telemetry_table(target).put([{**late, "samples": items[0]["samples"]}])
    exit_code, told = moved("--dry-run")
    assert (exit_code, told["problem"]) == (1, "1 batches have another content in the target")


def test_an_hour_that_both_have_archived_is_merged(
    embedded: EmbeddedCloud, other: EmbeddedCloud, movers: tuple[Side, Side], tmp_path: Path
) -> None:
    robot = "parted"
    robots.add(embedded.cloud, robot, out=tmp_path)
    for cloud, first in ((embedded.cloud, 0), (other.cloud, 1)):
        # In the archive alone, as after the retention.
        items, topic = stored(cloud, robot)[first : first + 2], topic_of(cloud, robot, STREAM)
        telemetry_table(cloud).put(items)
        archive.run(cloud, topic)
        archive.wait(cloud, lambda _left: None)
        for item in items:
            key = {name: item[name] for name in (TOPIC, BATCH)}
            table = cloud.output("storage", "TelemetryTable")
            cloud.client("dynamodb").delete_item(TableName=table, Key=key)
    for copied in (1, 0):
        done = iort(movers[0], "move", robot, "--to", str(movers[1].folder), "--json", "--same-robots")
        (told,) = [one for one in json.loads(done.stdout)["streams"] if one["stream"] == STREAM]
        assert (done.exit_code, told["problem"], told["copied_batches"], told["more"]) == (0, "", copied, 1)
    # By its hash the batch is the archived one, though it may be compressed in another way.
    archive.run(other.cloud, topic)
    archive.wait(other.cloud, lambda _left: None)
    assert [row.batches for row in archive_of(other.cloud, topic).rows()] == [3]


def test_a_robot_moves_with_everything_that_is_known_of_it(
    embedded: EmbeddedCloud, other: EmbeddedCloud, movers: tuple[Side, Side], tmp_path: Path
) -> None:
    robot, source, target = "known", embedded.cloud, other.cloud
    robots.add(source, robot, out=tmp_path / "source", vehicle=VEHICLE)
    robots.change_tags(source, robot, {"lab": "north"})
    note = findings.write_note(source, robot, "new tyres", by="anna")
    control.Shadow(source, robot).desire({"live.rate_hz": 5.0, "motion.stopped": True})
    now_ms = {"N": str(int(time.time() * 1000))}
    letter: dict[str, Any] = {
        ROBOT_KEY: {"S": robot},
        ENTRY: {"S": "0123"},
        PAYLOAD: {"B": b"\0\xff"},
        FIRST_MS: now_ms,
        LAST_MS: now_ms,
    }
    waiting = json.dumps({PUT_OFF: [[topic_of(source, robot, STREAM), "1-0-0"]]}).encode()
    later = {**letter, ENTRY: {"S": "4567"}, PAYLOAD: {"B": waiting}}
    later |= {SOURCE: {"S": BY_LATER}, TOPIC: {"S": topic_of(source, robot, STREAM)}}
    for one in (letter, later):
        source.client("dynamodb").put_item(TableName=source.output("storage", "QuarantineTable"), Item=one)

    def move() -> None:
        done = iort(
            movers[0], "move", robot, "--to", str(movers[1].folder), "--bundles", str(tmp_path / "new")
        )
        assert done.exit_code == 0, done.stdout

    def desired() -> dict[str, Any]:
        return dict(control.read(target.client("iot-data"), robot).desired.settings)

    move()
    row = registry.get(target, robot)
    assert {name: float(row[name]) for name in VEHICLE} == VEHICLE
    assert robots.tags(target)[robot]["lab"] == "north"
    assert findings.notes(target, robot) == [note]
    kept, replayed = sorted(quarantine.entries(target, robot=robot), key=lambda one: one.id)
    assert quarantine.load(target, kept) == quarantine.load(source, kept)
    assert [one.fate for one in quarantine.replay(target, [replayed])] == [quarantine.Fate.REPLAYED]
    assert desired() == {"live.rate_hz": 5.0, "motion.stopped": True}
    # Until the robot is there, changes follow.
    registry.set_vehicle(source, robot, {"speed_to_erpm_gain": 5000.0})
    control.Shadow(source, robot).desire({"live.rate_hz": None, "motion.stopped": False})
    move()
    assert float(registry.get(target, robot)["speed_to_erpm_gain"]) == 5000.0
    assert desired() == {"motion.stopped": False}
    assert list(quarantine.entries(target, robot=robot)) == [kept]
    # Then its new cloud's values stay.
    with Robot(tmp_path / "new" / robot) as there:
        there.online()
    until(lambda: CONNECTED_MS in registry.get(target, robot))
    control.Shadow(target, robot).desire({"motion.stopped": True})
    findings.remove_note(target, robot, note.id)
    move()
    assert desired() == {"motion.stopped": True}
    assert findings.notes(target, robot) == []


def test_two_robots_of_one_name_are_not_mixed(
    embedded: EmbeddedCloud, other: EmbeddedCloud, tmp_path: Path
) -> None:
    for i, side in enumerate((embedded, other)):
        robots.add(side.cloud, "twin", out=tmp_path / str(i))
    move = ("move", "twin", "--to", str(other.folder))
    assert "both sides have registered twin, and not by a move" in str(iort(embedded, *move).exception)
    for options in (["--same-robots"], []):
        assert iort(embedded, *move, *options).exit_code == 0
    # And back.
    assert iort(other, "move", "twin", "--to", str(embedded.folder)).exit_code == 0


def audited(side: EmbeddedCloud, robot: str) -> dict[str, Any]:
    """What `iort audit` says of the stream."""
    streams = json.loads(iort(side, "audit", robot, "--json").stdout)["streams"]
    return {one["stream"]: one for one in streams}[STREAM]


@pytest.mark.parametrize("way", ["bundle", "claim"])
def test_a_robot_drives_on_in_the_target_with_its_queue(
    embedded: EmbeddedCloud, other: EmbeddedCloud, tmp_path: Path, way: str
) -> None:
    robot, source, target = f"driver-{way}", embedded.cloud, other.cloud
    move_ = ("move", robot, "--to", str(other.folder))
    sim = [{"type": "sim", "stream": STREAM, "rate_hz": 50}]
    car = robots.add(
        source, robot, out=tmp_path / "car", settings={"sources": sim, "queue": {"path": "q.db"}}
    )
    with Proxy("127.0.0.1", source.mqtt_port) as proxy:
        robots.configure(car, {"port": proxy.port})
        # What is left when it ends stays in the queue.
        with Agent(car, drain_s=1) as agent:
            until(lambda: len(list(audit.batches(source, robot, STREAM))) >= 2)
            proxy.mode = REFUSE
            # These stay in the queue on the robot's disk.
            until(lambda: agent.told()["spool"]["batches"] >= 6)
    there = {(batch.boot, batch.seq) for batch in audit.batches(source, robot, STREAM)}
    boots = {boot for boot, _ in there}
    if way == "bundle":
        done = iort(embedded, *move_, "--bundles", str(tmp_path / "new"))
        new = yaml.safe_load((tmp_path / "new" / robot / "car.yaml").read_text())
        named = {
            name: str(tmp_path / "new" / robot / new[name])
            for name in ("certificate", "private_key", "root_ca")
        }
        robots.configure(car, {**named, "endpoint": new["endpoint"], "port": new["port"]})
    else:
        done = iort(embedded, *move_)
        # The claim's files beside car.yaml, which keeps the robot's own settings.
        claim = identity.claim(target, robot, out=car.folder)
        command("provision", "--config", claim)
    assert done.exit_code == 0, done.stdout
    with Agent(car):
        until(lambda: {batch.boot for batch in audit.batches(target, robot, STREAM)} - boots)
    done = iort(embedded, *move_)
    assert done.exit_code == 0, done.stdout
    assert re.search(
        rf"{robot} {STREAM}: .* 0 missing; .*; the same, \w+; the target has \d+ more", done.stdout
    )
    # Neither side has a gap, and the target has the whole of both runs.
    old, new = (audited(side, robot) for side in (embedded, other))
    assert (old["missing"], new["missing"], new["complete"]) == (0, 0, True)
    first = {batch.seq for batch in audit.batches(target, robot, STREAM) if batch.boot in boots}
    assert first == set(range(len(first)))
    assert len(first) > len(there)


def test_who_lacks_a_right_is_told_where_they_are_listed(
    embedded: EmbeddedCloud, other: EmbeddedCloud, tmp_path: Path
) -> None:
    robots.add(embedded.cloud, "kept-out", out=tmp_path / "car")
    reader = limited(other, "source", tmp_path)
    refused = str(iort(embedded, "move", "kept-out", "--to", str(reader.folder)).exception)
    assert "dynamodb:PutItem" in refused
    assert "docs/how-to/move.md lists the rights" in refused
