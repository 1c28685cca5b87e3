"""The examples in the help of `iort` on the embedded cloud, as an operator types them."""

from __future__ import annotations

import hashlib
import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from iort_agent.sources.sim.driver import HALL
from iort_contract.messages.files import File, file_key
from iort_station.fleet import robots
from iort_station.operations import recompute
from local.demo import DOWNLINK
from testkit.bags import written
from testkit.waiting import until
from tests.local.conftest import recorded
from tests.local.data.drives import Agent
from tests.manual import COMMANDS, examples

# Commands that need what an embedded cloud does not have, or that change what other tests use.
# Laps and a calibration need minutes of driving, `iort drive` a terminal, and `iort invite` a page. `iort
# bridge` runs until Ctrl-C.
NOT_RUN = {
    *(
        "ask",
        "backup",
        "bridge",
        "dashboard",
        "drive",
        "files empty",
        "invite",
        "laps",
        "move",
        "pubnub",
        "restore",
    ),
    *("robots revoke-claims", "site"),
    # Nobody answers at the example's address.
    *("webhook remove", "webhook set", "webhook test"),
}
# Runs until Ctrl-C.
ENDLESS = "iort watch"
# These need a car that drives; audit counts what is still in a car.
OF_A_DRIVE = ("trace", "watch", "send", "config")


@pytest.fixture(scope="module")
def car7(embedded, tmp_path_factory):
    """The examples' robot, with a file."""
    settings = {"sources": [{"type": "sim", "rate_hz": 50}], "downlink": DOWNLINK}
    car = robots.add(embedded.cloud, "car7", out=tmp_path_factory.mktemp("car7"), settings=settings)
    sha256 = hashlib.sha256(b"drive").hexdigest()
    file = File("drive.bag", "recording", "application/octet-stream", 5, sha256, time.time_ns() // 1000)
    embedded.cloud.client("s3").put_object(
        Bucket=embedded.cloud.output("storage", "FilesBucket"),
        Key=file_key("car7", file),
        Body=b"drive",
        Metadata={"sha256": sha256},
    )
    yield car
    robots.remove(embedded.cloud, "car7")


@pytest.mark.heavy
def test_every_example_does_what_it_says(embedded, iort, car7, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "track.json").write_text(json.dumps({"track": HALL.csv()}))
    written(tmp_path / "drive.bag", "bag", seconds=1.0)
    # It would wait a minute for Lambda 2's cache of parameters.
    monkeypatch.setattr(recompute, "wait_until_settled", lambda: None)

    with Agent(car7):
        recorded(embedded, "car7", "pose")
        for name in OF_A_DRIVE:
            # PubNub's SDK leaves its sockets to the end of the process.
            command = [
                Path(sys.executable).parent / "iort",
                "--local",
                "--embedded",
                embedded.folder / "cloud.json",
            ]
            for example in examples(name):
                if example != ENDLESS:
                    # On a slow machine a command may come too late, or an answer.
                    given = [*command, *shlex.split(example)[1:]]
                    until(lambda given=given: not subprocess.run(given, check=False).returncode)
    # A robot is added before it is removed.
    for name in sorted(
        COMMANDS.keys() - {*NOT_RUN, *OF_A_DRIVE}, key=lambda name: (name != "robots add", name)
    ):
        for example in examples(name):
            outcome = iort(*shlex.split(example)[1:])
            assert outcome.exit_code == 0, f"{example}: {outcome.output} {outcome.exception!r}"
    files = {path.name for path in tmp_path.iterdir()}
    assert files >= {"speed.png", "track.png", "car7.mcap", "car7.parquet", "bags", "robots", "claim-car9"}
    assert COMMANDS.keys() >= NOT_RUN
