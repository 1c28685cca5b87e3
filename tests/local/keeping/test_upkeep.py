"""`iort doctor`, `iort backup` and `iort restore` of a cloud of `make up`, while a car drives."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from iort_contract.catalog.vesc import VESC_STREAM
from iort_station import kept
from iort_station.cli.main import app
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from iort_station.operations.delivery import counts
from local.deployment import ROOT
from tests.local.conftest import until


@contextmanager
def up(folder: Path) -> Iterator[Cloud]:
    """The cloud of `make up`, from its start to its stop."""
    # The usual ports may be those of a cloud of this machine.
    command = [sys.executable, "-m", "local.up.run", "--state", folder, "--ports", "any"]
    log = folder.with_suffix(".txt")
    with (
        log.open("w") as output,
        subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output) as process,
    ):
        try:
            until(lambda: "to stop" in log.read_text() or process.poll() is not None, seconds=180)
            assert process.poll() is None, log.read_text()
            yield Cloud.load(folder / kept.CLOUD)
        finally:
            process.terminate()


def iort(folder: Path) -> Callable[..., Any]:
    """The operator's command for a cloud of `make up`."""
    where = ["--local", "--embedded", str(folder / kept.CLOUD)]
    return lambda *arguments: CliRunner().invoke(
        app, [*where, *map(str, arguments)], env={"IORT_STATE": str(folder)}
    )


def stored(cloud: Cloud) -> list[tuple[str, int]]:
    """The batches of the car: run and number."""
    return [(one.boot, one.seq) for one in counts.batches(cloud, "car1", VESC_STREAM)]


def findings(folder: Path, status: int) -> dict[str, Any]:
    asked = iort(folder)("doctor", "--json")
    assert asked.exit_code == status, asked.output
    return {one["what"]: one for one in json.loads(asked.stdout)}


def test_a_backup_of_a_cloud_that_a_car_writes_to_has_everything_so_far(tmp_path):
    folder, archive, restored = tmp_path / "cloud", tmp_path / "cloud.tar", tmp_path / "restored"
    with up(folder) as cloud:
        source = {"type": "sim", "stream": VESC_STREAM, "rate_hz": 50}
        car = robots.add(cloud, "car1", out=tmp_path, settings={"sources": [source]})
        agent = Path(sys.executable).parent / "iort-agent"
        with subprocess.Popen([agent, "--config", car.config], stderr=subprocess.PIPE) as driving:
            try:
                until(lambda: len(stored(cloud)) >= 3)
                before = stored(cloud)
                assert "files" in iort(folder)("backup", archive).output
                # It goes on.
                until(lambda: len(stored(cloud)) > len(before) + 1)
                found = findings(folder, status=0)
            finally:
                driving.terminate()
                driving.communicate(timeout=60)
        assert found["robots"]["text"] == "1 of 1 are connected"
        assert found["backup"]["text"].endswith(str(archive))
        assert "recordings at most" in found["summaries"]["text"]
        assert {"servers", "memory", "load", "disk", "certificate of broker", "clock"} <= found.keys()
        refused = iort(folder)("restore", archive, "--force")
        assert "stop it first" in str(refused.exception)
    assert findings(folder, status=1)["processes"]["level"] == "fail"
    assert iort(restored)("restore", archive).exit_code == 0
    with up(restored) as cloud:
        assert set(stored(cloud)) >= set(before)
        # The car is known there, with its certificate.
        car_again = subprocess.run(
            [agent, "check", "--config", car.config], capture_output=True, text=True, check=False
        )
        assert "accepts car1" in car_again.stdout, car_again.stdout
        assert iort(restored)("audit", "car1").exit_code == 0
