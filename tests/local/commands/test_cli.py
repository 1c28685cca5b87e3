"""The command `iort` against the embedded cloud."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from iort_contract.messages.files import File, file_key
from iort_station.cli.main import app
from iort_station.cloud import EMBEDDED, EMBEDDED_VARIABLE, Cloud
from testkit.ports import free_port
from testkit.waiting import GUARD_S, until
from tests.local.conftest import run_agent


def test_a_robot_is_added_listed_and_removed(iort, tmp_path):
    added = iort("robots", "add", "cli-car", "--out", str(tmp_path), "--speed-to-erpm-gain", "3000")
    assert added.exit_code == 0, added.output
    # The cloud listens on loopback alone.
    assert "run here" in added.output
    key = tmp_path / "cli-car" / "private.key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    listed = json.loads(iort("robots", "list", "--json").output)
    (told,) = (row for row in listed if row["robot"] == "cli-car")
    assert (told["speed_to_erpm_gain"], told["online"], told["connected"], told["streams"]) == (
        3000.0,
        False,
        None,
        [],
    )
    assert all(row.keys() == told.keys() for row in listed)
    assert not {"session_version", "admit_claim", "admit_fingerprint"} & told.keys()
    shown = iort("robots", "list").stdout
    assert f"{'cli-car':<8}" in shown
    assert "speed_to_erpm_gain 3000" in shown
    assert iort("robots", "tag", "cli-car", "lab=north", "team=blue").exit_code == 0
    assert iort("robots", "tag", "cli-car", "--remove", "team").output == "lab=north\nvehicle=vesc\n"
    assert "a tag's value must be" in str(iort("robots", "tag", "cli-car", "lab=two words").exception)
    assert "is not registered; the nearest: " in str(iort("robots", "tag", "cli-cra").exception)
    assert iort("robots", "remove", "cli-car", "--yes").exit_code == 0
    assert "cli-car" not in iort("robots", "list").output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("robots", "add", "car/1"), "got 'car/1'"),
        (("config", "car/1"), "got 'car/1'"),
        *(
            (command.split(), "robot nobody is not registered")
            for command in (
                *("trace nobody", "runs nobody", "streams nobody", "audit nobody", "config nobody"),
                *("errors --robot nobody", "query nobody vesc", "send nobody drive {}"),
                *("robots remove nobody", "robots show nobody", "robots rotate nobody"),
                *("files get nobody", "files list nobody", "files list nobody --last 1h --json"),
            )
        ),
        (("pubnub", "--publish-key", "pub-c-1", "--subscribe-key", "sub-c-1"), "with its own keys"),
    ],
)
def test_an_error_states_its_cause(iort, tmp_path, arguments, said):
    outcome = iort(*arguments)
    assert outcome.exit_code != 0
    assert said in str(outcome.exception)


def test_commands_escape_terminal_sequences_from_a_robot(embedded, iort, bundle):
    """A robot controls these texts: its shadow, and reasons it gives."""
    robot = bundle().robot
    embedded.cloud.client("dynamodb").update_item(
        TableName=embedded.cloud.output("storage", "RobotsTable"),
        Key={"robot": {"S": robot}},
        UpdateExpression="SET agent_version = :hostile",
        ExpressionAttributeValues={":hostile": {"S": "\x1b]52;c;YQ==\x07[/]"}},
    )
    for arguments in (("list",), ("show", robot)):
        outcome = iort("robots", *arguments)
        assert outcome.exit_code == 0, outcome.exception
        assert "\\u001b]52;c;YQ==\\u0007[/]" in outcome.output
        assert "\x1b" not in outcome.output


def test_files_are_listed_for_existing_and_removed_robots(embedded, iort, bundle):
    robot = bundle().robot
    none = iort("files", "list", robot)
    assert (none.exit_code, none.stdout, none.stderr) == (0, "", "no matching files\n")
    bucket = embedded.cloud.output("storage", "FilesBucket")
    file = File("a.bag", "recording", "application/octet-stream", 5, "0" * 64, 1_700_000_000_000_000)
    key = file_key("gone", file)
    embedded.cloud.client("s3").put_object(Bucket=bucket, Key=key, Body=b"drive")
    assert "a.bag" in iort("files", "list", "gone").output
    later = iort("files", "list", "gone", "--last", "1h")
    assert (later.exit_code, later.stdout) == (0, "")


def test_a_killed_embedded_cloud_is_reported_as_not_answering(tmp_path):
    port = free_port()
    Cloud(endpoint_url=f"https://127.0.0.1:{port}").save(tmp_path / "cloud.json")
    outcome = CliRunner().invoke(
        app, ["--local", "--embedded", str(tmp_path / "cloud.json"), "robots", "list"]
    )
    assert f"{tmp_path / 'cloud.json'} does not answer" in str(outcome.exception)


def test_a_robot_cannot_be_added_twice(iort, tmp_path):
    assert iort("robots", "add", "twice", "--out", str(tmp_path / "a")).exit_code == 0
    assert "already registered" in str(iort("robots", "add", "twice", "--out", str(tmp_path / "b")).exception)


@pytest.fixture
def tab(embedded, tmp_path):
    """What bash offers after these words: `tab("query", "ca")`."""

    def offered(*words, embedded_file=embedded.folder / EMBEDDED.name):
        asked = {
            "_IORT_COMPLETE": "complete_bash",
            "COMP_WORDS": " ".join(["iort", *words]),
            "COMP_CWORD": str(len(words)),
            EMBEDDED_VARIABLE: str(embedded_file),
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
        }
        command = Path(sys.executable).parent / "iort"
        done = subprocess.run(
            [command],
            env={**os.environ, **asked},
            capture_output=True,
            text=True,
            timeout=GUARD_S,
            check=True,
        )
        assert done.stderr == ""
        return done.stdout.split()

    return offered


def test_tab_offers_names_and_never_an_error(tab, bundle, embedded):
    robot = bundle(sources=[{"type": "sim", "duration_s": 1}])
    run_agent(robot)
    until(lambda: robot.robot in tab("query", robot.robot[:9]))
    until(lambda: tab("query", robot.robot, "v") == ["vesc"])
    offered = until(lambda: tab("query", robot.robot, "vesc", "--fields", "duty_cycle,s"))
    assert offered == ["duty_cycle,speed", "duty_cycle,speed_mps"]
    assert tab("query", "x", embedded_file=embedded.folder / "nowhere.json") == []
    assert sorted(tab("robots", "re")) == ["register", "remove", "revoke-claims"]
