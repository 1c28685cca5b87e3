"""The thesis' four ways to query, over several pages, with the function's own role enforced."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from boto3.dynamodb.types import TypeSerializer

from iort_contract.cloud import RESULTS_PREFIX
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import build_topic
from iort_station import data
from local.cloud import EmbeddedCloud
from local.deployment import ROOT
from testkit.waiting import GUARD_S

START = 1_700_000_000_000_000
BATCHES, EACH, FIELDS = 80, 150, 50
N = BATCHES * EACH
ROBOT, STREAM = "asked", "noise"


def store(embedded, robot, stream, batches):
    """Put batches into the table as the record rule does."""
    serialize = TypeSerializer().serialize
    table, client = embedded.cloud.output("storage", "TelemetryTable"), embedded.cloud.client("dynamodb")
    for batch in batches:
        item = {**json.loads(encode_batch(batch)), "topic": build_topic("dt", robot, stream)}
        client.put_item(TableName=table, Item={name: serialize(value) for name, value in item.items()})


@pytest.fixture(scope="module")
def noise(embedded: EmbeddedCloud) -> dict[str, list[float]]:
    """Make about 6 MB of incompressible samples, too large for a page of DynamoDB or an answer of Lambda."""
    chance = random.Random(1)
    columns = {f"f{i}": [chance.random() for _ in range(N)] for i in range(FIELDS)}
    batches = [
        Batch(
            "0badcafe",
            i,
            [START + 5_000 * k for k in range(i * EACH, (i + 1) * EACH)],
            {name: column[i * EACH : (i + 1) * EACH] for name, column in columns.items()},
        )
        for i in range(BATCHES)
    ]
    store(embedded, ROBOT, STREAM, batches)
    return columns


@pytest.mark.parametrize("on", ["client", "lambda"])
@pytest.mark.parametrize("scan", [False, True])
def test_all_four_ways_return_the_same_samples(embedded, noise, on, scan):
    first, last = START + 1_000_001, START + 31_000_000
    found = data.query(
        embedded.cloud, ROBOT, STREAM, first, last, fields=["f0", "f7"], where="f7 > 0.5", on=on, scan=scan
    )
    expected = [k for k in range(N) if first <= START + 5_000 * k < last and noise["f7"][k] > 0.5]
    assert found.times_us.tolist() == [START + 5_000 * k for k in expected]
    assert found.columns["f0"].tolist() == [noise["f0"][k] for k in expected]


@pytest.mark.parametrize("on", ["client", "lambda"])
def test_a_result_of_many_pages_is_complete(embedded, noise, on):
    pages = []
    found = data.query(embedded.cloud, ROBOT, STREAM, on=on, progress=lambda items, _: pages.append(items))
    assert len(found) == N
    assert sum(pages) == BATCHES
    if on == "client":
        assert len(pages) > 3
    else:
        bucket = embedded.cloud.output("storage", "FilesBucket")
        kept = embedded.cloud.client("s3").list_objects_v2(Bucket=bucket, Prefix=RESULTS_PREFIX)
        assert kept["KeyCount"] >= 1
    for name, column in noise.items():
        np.testing.assert_array_equal(found.columns[name], column)


def test_the_command_writes_its_matches_and_their_number(iort, noise, tmp_path):
    asked = ["query", ROBOT, STREAM, "--last", "all", "--fields", "f1"]
    done = iort(*asked, "--every", "10s", "--json")
    assert done.exit_code == 0, done.output
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(rows) == 6
    assert rows[0]["f1"] == pytest.approx(np.mean(noise["f1"][:2000]))
    assert "6 samples" in done.stderr
    done = iort(*asked, "--format", "csv", "--out", str(tmp_path / "f1.csv"))
    assert done.exit_code == 0, done.output
    assert len((tmp_path / "f1.csv").read_text().splitlines()) == N + 1
    done = iort("query", ROBOT, "imu", "--last", "all")
    assert "robot asked is not registered" in str(done.exception)


@pytest.mark.usefixtures("noise")
def test_a_closed_pipe_is_not_an_error(embedded):
    iort_ = Path(sys.executable).parent / "iort"
    done = subprocess.run(
        f"'{iort_}' --local --embedded '{embedded.folder}/cloud.json' "
        f"query {ROBOT} {STREAM} --last all --json | head -c 10",
        shell=True, cwd=ROOT, capture_output=True, text=True, check=False, timeout=GUARD_S,
    )  # fmt: skip
    assert done.stdout == '{"time": "'
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr


def test_the_command_draws_a_plot(iort, noise, tmp_path):
    picture = tmp_path / "noise.svg"
    asked = ["plot", ROBOT, STREAM, "--last", "all", "--fields", "f0,f1", "--out", str(picture)]
    done = iort(*asked, "--kind", "distribution")
    assert done.exit_code == 0, done.output
    assert f"{N:,} samples" in done.stdout
    assert picture.read_text().startswith("<?xml")
    done = iort(*asked[:-1], str(tmp_path / "where.svg"), "--kind", "trajectory")
    assert "no position" in str(done.exception)
