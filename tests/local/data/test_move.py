"""A robot moves from one embedded cloud into another: interrupted, gone on with, and compared."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from iort_contract.cloud import IOT
from iort_contract.messages.batch import BatchId
from iort_contract.tables import BATCH, TOPIC
from iort_station import data
from iort_station.cli.main import app
from iort_station.cloud import EMBEDDED
from iort_station.data.analysis import notes
from iort_station.data.batches import telemetry_table, topic_of
from iort_station.errors import StationError
from iort_station.fleet import registry, robots, tags
from iort_station.operations import archive, move
from local.cloud import EmbeddedCloud
from tests.local.data.test_archive import HOUR_US, START, stored
from tests.ports import free_port

ROBOT, STREAM = "moving", "vesc"
VEHICLE = {"speed_to_erpm_gain": 4614.0, "speed_to_erpm_offset": 1.5}


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedCloud]:
    ports = {name: free_port() for name in ("gateway", "mqtt")}
    with EmbeddedCloud(tmp_path_factory.mktemp("other") / "local", live=IOT, ports=ports) as cloud:
        yield cloud


def test_a_robot_moves_with_everything_that_it_has_recorded(
    embedded: EmbeddedCloud, other: EmbeddedCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = embedded.cloud, other.cloud
    robots.add(source, ROBOT, out=tmp_path / "source", vehicle=VEHICLE)
    tags.change(source, ROBOT, {"lab": "north"})
    note = notes.write(source, ROBOT, "new tyres", by="anna")
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
    before = data.query(source, ROBOT, STREAM)
    assert len(before) == 61 * 50

    def iort(cloud: EmbeddedCloud, *arguments: str) -> Any:
        where = ["--local", "--embedded", str(cloud.folder / EMBEDDED.name)]
        return CliRunner().invoke(app, [*where, *arguments])

    def moved(*options: str) -> tuple[int, dict[str, Any]]:
        done = iort(embedded, "move", ROBOT, "--to", str(other.folder), "--json", *options)
        told = {one["stream"]: one for one in json.loads(done.stdout)["streams"]}
        return done.exit_code, told[STREAM]

    exit_code, told = moved("--dry-run")
    assert (exit_code, told["problem"][:26]) == (1, "the source has 61 batches,")

    # It is interrupted before the table's batches are written.
    def broken(*_: Any) -> None:
        raise StationError("the network is gone")

    with monkeypatch.context() as patch:
        patch.setattr(move, "write", broken)
        bundles = ("--bundles", str(tmp_path / "bundles"))
        assert iort(embedded, "move", ROBOT, "--to", str(other.folder), *bundles).exit_code == 1
    exit_code, told = moved()
    assert (exit_code, told["problem"], told["copied_hours"], told["copied_batches"]) == (0, "", 0, 21)
    assert (told["batches"], told["samples"], told["missing"]) == (61, 61 * 50, 0)
    assert moved()[1]["copied_batches"] == 0

    after = data.query(target, ROBOT, STREAM)
    assert after.times_us.tolist() == before.times_us.tolist()
    assert after.columns["speed"].tolist() == before.columns["speed"].tolist()
    audits = [json.loads(iort(cloud, "audit", ROBOT, "--json").stdout) for cloud in (embedded, other)]
    assert audits[0]["streams"] == audits[1]["streams"] != []
    row = registry.get(target, ROBOT)
    assert {name: float(row[name]) for name in VEHICLE} == VEHICLE
    assert tags.listed(target)[ROBOT]["lab"] == "north"
    assert notes.notes(target, ROBOT) == [note]
    assert (tmp_path / "bundles" / ROBOT / "car.yaml").exists()
    # A batch whose content is another one is found, though the counts agree.
    telemetry_table(target).put([{**late, "samples": items[0]["samples"]}])
    exit_code, told = moved("--dry-run")
    assert (exit_code, told["problem"]) == (1, "the contents differ")
