"""`iort audit` on the embedded cloud: complete after a drive, a gap when a batch is taken away."""

from __future__ import annotations

import json

from typer.testing import CliRunner

from contract import RECORD, T_US, TOPIC, build_topic
from station import audit
from station.cli import app
from tests.local.conftest import run_agent


def _run(embedded, *arguments):
    where = ["--local", "--embedded", str(embedded.folder / "cloud.json")]
    return CliRunner().invoke(app, [*where, "audit", *arguments, "--json"])


def test_a_drive_is_proven_and_a_lost_batch_is_found(embedded, bundle):
    car = bundle(
        sources=[{"type": "sim", "stream": "vesc", "rate_hz": 100, "duration_s": 2}],
        record={"batch_s": 0.25},
        live={"enabled": False},
    )
    run_agent(car)
    done = _run(embedded, car.robot, "--stream", "vesc", "--from-start")
    assert done.exit_code == 0, done.output
    (stream,) = json.loads(done.stdout)
    assert (stream["complete"], sum(run["samples"] for run in stream["runs"])) == (True, 200)
    found = list(audit.headers(embedded.cloud, car.robot, "vesc", audit.Range()))
    assert all("samples" not in item for item in found)
    embedded.cloud.client("dynamodb").delete_item(
        TableName=embedded.cloud.output("storage", "TelemetryTable"),
        Key={
            TOPIC: {"S": build_topic(RECORD, car.robot, "vesc", embedded.namespace)},
            T_US: {"N": found[3][T_US]},
        },
    )
    done = _run(embedded, car.robot, "--stream", "vesc")
    assert done.exit_code == 1
    (gap,) = json.loads(done.stdout)[0]["runs"][0]["missing"]
    assert gap["first"] == gap["last"] == int(found[3]["seq"])
    assert _run(embedded, "nobody-like-that").exit_code == 1
