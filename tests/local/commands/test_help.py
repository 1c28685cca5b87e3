"""The examples in the help of `iort` on the embedded cloud, as an operator types them."""

from __future__ import annotations

import hashlib
import shlex
import time

import pytest

from iort_contract.messages.files import File, file_key
from iort_station.fleet import robots
from iort_station.operations import recompute
from tests.local.conftest import run_agent
from tests.manual import COMMANDS, examples

# These need what an embedded cloud does not have, run until Ctrl-C, or delete what other tests need.
NOT_RUN = {
    "files empty": "deletes every file",
    "robots revoke-claims": "revokes the claims of other tests",
    "pubnub": "the embedded cloud has its own keys",
    "dashboard": "runs until Ctrl-C",
    "watch": "listens to PubNub's stand-in, which this cloud does not have",
    "trace": "as watch",
    "site": "the embedded cloud has no CloudFront",
    "adopt": "needs an old table",
    "send": "needs a running car with a downlink",
}


@pytest.fixture(scope="module")
def car7(embedded, tmp_path_factory):
    """The examples' robot, with a drive of two seconds and a file."""
    folder = tmp_path_factory.mktemp("car7")
    sim = {"type": "sim", "rate_hz": 50, "duration_s": 2}
    car = robots.add(embedded.cloud, "car7", out=folder, settings={"sources": [sim]})
    run_agent(car)
    sha256 = hashlib.sha256(b"drive").hexdigest()
    file = File("drive.bag", "recording", "application/octet-stream", 5, sha256, time.time_ns() // 1000)
    embedded.cloud.client("s3").put_object(
        Bucket=embedded.cloud.output("storage", "FilesBucket"),
        Key=file_key("car7", file),
        Body=b"drive",
        Metadata={"sha256": sha256},
    )
    yield folder
    robots.remove(embedded.cloud, "car7")


def test_every_example_does_what_it_says(iort, car7, monkeypatch):
    monkeypatch.chdir(car7)
    # It would wait a minute for Lambda 2's cache of parameters.
    monkeypatch.setattr(recompute, "wait_until_settled", lambda: None)
    # A robot is added before it is removed.
    for name in sorted(COMMANDS.keys() - NOT_RUN.keys(), key=lambda name: (name != "robots add", name)):
        for example in examples(name):
            outcome = iort(*shlex.split(example)[1:])
            assert outcome.exit_code == 0, f"{example}: {outcome.output} {outcome.exception!r}"
    written = {path.name for path in car7.iterdir()}
    assert {"speed.png", "track.png", "car7.mcap", "car7.parquet", "bags", "robots", "claim-car9"} <= written
    assert NOT_RUN.keys() <= COMMANDS.keys()
