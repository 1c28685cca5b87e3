"""`iort-agent check`, `status`, the agent's own stream and `iort doctor`, on the embedded cloud."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from iort_agent.sources import OK
from iort_agent.sources.ros1 import Ros1Config
from iort_contract.catalog.streams import AGENT_FIELDS, AGENT_STREAM
from iort_contract.messages.files import File, file_key
from iort_station.data.recorded import topic_of
from iort_station.operations import audit
from testkit.waiting import until
from tests.local.conftest import command
from tests.local.data.drives import Agent
from tests.local.faults.test_uplink import self_signed, set_status


def findings(config: Path, *, status: int) -> dict[str, dict[str, str]]:
    done = command("check", "--config", config, "--json", status=status)
    return {one["what"]: one for one in json.loads(done.stdout)}


def test_a_correct_robot_passes_every_check(bundle):
    car = bundle(queue={"path": "queue.db"})
    found = findings(car.config, status=0)
    assert {one["level"] for one in found.values()} == {OK}, found
    assert found["broker"]["text"] == f"accepts {car.robot}"
    assert "certificate's" in found["private key"]["text"]


def test_the_check_reports_a_revoked_certificate(embedded, bundle):
    car = bundle()
    set_status(embedded, car.robot, "REVOKED")
    found = findings(car.config, status=1)
    assert found["certificate"]["level"] == found["server certificate"]["level"] == OK
    assert found["broker"]["level"] == "fail"
    assert "not active" in found["broker"]["todo"]


def test_the_check_reports_another_robots_certificate(bundle):
    one, other = bundle("one"), bundle("other")
    shutil.copy(other.folder / "certificate.pem", one.folder / "certificate.pem")
    found = findings(one.config, status=1)
    assert "is not the key of" in found["private key"]["text"]
    shutil.copy(other.folder / "private.key", one.folder / "private.key")
    assert "not authorized" in findings(one.config, status=1)["broker"]["text"]


def test_the_check_reports_a_wrong_authority_a_readable_key_and_failing_sources(bundle, tmp_path):
    topics = {"/a": {"stream": "a", "time": "arrival"}}
    car = bundle(
        sources=[
            {"type": "vesc", "port": str(tmp_path / "ttyACM0")},
            {"type": "rosbridge", "url": "ws://127.0.0.1:9", "topics": topics},
        ]
    )
    self_signed(tmp_path)
    shutil.copy(tmp_path / "certificate.pem", car.folder / "root-ca.pem")
    (car.folder / "private.key").chmod(0o644)
    found = findings(car.config, status=1)
    assert found["server certificate"]["level"] == "fail"
    assert "root_ca" in found["server certificate"]["todo"]
    assert found["key's mode"]["level"] == "warn"
    vesc, rosbridge = (one for what, one in found.items() if what.startswith("source"))
    assert "is not there" in vesc["text"]
    assert rosbridge["level"] == "fail"


def test_the_doctor_of_a_cloud_that_is_thrown_away(iort):
    asked = iort("doctor", "--json")
    found = {one["what"]: one for one in json.loads(asked.stdout)}
    assert asked.exit_code == 0, found
    assert list(found) == ["machine", "stacks", "robots", "summaries", "alarms"]
    assert found["machine"]["level"] == "warn"
    assert "`make up`" in found["machine"]["todo"]
    assert "are connected" in found["robots"]["text"]


def test_the_deep_look_names_a_damaged_item_and_a_damaged_file(embedded, bundle, iort):
    car, cloud = bundle(), embedded.cloud
    files = {name: File(name, "log", "text/plain", 5, sha256(b"hello").hexdigest(), 1) for name in "ab"}
    keys = {name: file_key(car.robot, file) for name, file in files.items()}
    for name, content in (("a", b"hello"), ("b", b"hallo")):
        where = {"Bucket": cloud.output("storage", "FilesBucket"), "Key": keys[name]}
        cloud.client("s3").put_object(**where, Body=content, Metadata={"sha256": files[name].sha256})
    batch = f"{1_750_000_000_000_000}-0badcafe-7"
    item = {"topic": topic_of(cloud, car.robot, "vesc"), "batch": batch, "codec": "steps", "samples": "x"}
    cloud.client("dynamodb").put_item(
        TableName=cloud.output("storage", "TelemetryTable"),
        Item={name: {"S": text} for name, text in item.items()} | {"v": {"N": "2"}, "n": {"N": "50"}},
    )

    def failed() -> tuple[int, dict[str, str]]:
        asked = iort("doctor", "--deep", "--json")
        lines = [one for one in json.loads(asked.stdout) if one["level"] == "fail"]
        # Other tests may have damaged what they have stored.
        return asked.exit_code, {
            one["what"]: one["text"] for one in lines if one["what"].startswith(f"{car.robot} ")
        }

    status, found = failed()
    assert (status, set(found)) == (1, {f"{car.robot} vesc", f"{car.robot} b"})
    assert f"2025-06-15T15:06:40.000000Z ({batch}): " in found[f"{car.robot} vesc"]
    assert f"{keys['b']}: SHA-256 must be {files['b'].sha256}" in found[f"{car.robot} b"]
    key = {name: {"S": item[name]} for name in ("topic", "batch")}
    cloud.client("dynamodb").delete_item(TableName=cloud.output("storage", "TelemetryTable"), Key=key)
    cloud.client("s3").delete_object(Bucket=cloud.output("storage", "FilesBucket"), Key=keys["b"])
    assert failed()[1] == {}


@pytest.fixture
def ros_master(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False) as server:
        server.register_function(lambda _caller: [1, "", 4711], "getPid")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        monkeypatch.setenv("ROS_MASTER_URI", f"http://127.0.0.1:{server.server_address[1]}")
        yield
        server.shutdown()


def test_the_check_finds_a_ros_master(ros_master):
    *_, found = Ros1Config(topics=()).check("ros")
    assert (found.level, "process 4711" in found.text) == (OK, True)


def test_a_running_agent_reports_its_status(embedded, bundle):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}], metrics={"every_s": 1}, queue={})
    with Agent(car) as agent:
        assert agent.told()["robot"] == car.robot
        until(lambda: agent.told()["clock"])
        state = until(lambda: (now := agent.told())["streams"]["vesc"]["per_s"] > 0 and now)
        assert state["connection"]["connected"]
        # The emulator and the test share one clock.
        assert abs(state["clock"]["offset_ms"]) <= state["clock"]["uncertainty_ms"] + 1
        assert findings(car.config, status=0)["broker"]["text"] == "the running agent is connected"
        assert agent.told()["connection"]["connects"] == 1, "check took the connection"
        assert "connected for" in command("status", "--config", car.config).stdout
        second = command("--config", car.config, status=1)
        assert f"in use by another iort-agent (process {agent.process.pid})" in second.stderr
        samples = until(lambda: _own_samples(embedded, car.robot))
    assert samples.keys() == AGENT_FIELDS.keys()
    assert samples["connects"][-1] == 1
    assert 1 < samples["rss_mb"][-1] < 200
    assert not (car.folder / "agent.sock").exists()


def _own_samples(embedded: Any, robot: str) -> dict[str, Any] | None:
    found = list(audit.batches(embedded.cloud, robot, AGENT_STREAM))
    return dict(found[-1].columns) if found else None
