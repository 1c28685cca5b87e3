"""What the doctor says of a machine and of a deployment, and when it warns."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from datetime import datetime, timezone
from importlib.metadata import version
from types import SimpleNamespace

import boto3
import pytest

from iort_station import kept
from iort_station.errors import StationError
from iort_station.upkeep import deployment, doctor
from iort_station.upkeep.deployment import FAIL, OK, WARN
from iort_station.upkeep.snapshot import LAST_BACKUP, held
from tests.unit.station.data.test_queries import FakeCloud, cloud_of

DAY_S = 86_400


class Deployed(FakeCloud):
    """The fake cloud with moto's CloudWatch."""

    endpoint_url, region_name = None, "eu-west-1"

    def output(self, noun, name):
        return "iort-Summarize" if name == "SummarizeFunction" else super().output(noun, name)

    def client(self, service):
        return boto3.client(service) if service == "cloudwatch" else super().client(service)


def put(name, value, age_s, **dimensions):
    point = {
        "MetricName": name,
        "Value": value,
        "Timestamp": datetime.fromtimestamp(time.time() - age_s, timezone.utc),
        "Dimensions": [{"Name": name, "Value": value} for name, value in dimensions.items()],
    }
    namespace = "iort" if "Deployment" in dimensions else "AWS/Lambda"
    boto3.client("cloudwatch").put_metric_data(Namespace=namespace, MetricData=[point])


def looked(findings):
    return {one.what: one for one in findings}


@pytest.mark.parametrize(("behind_s", "level"), [(2, OK), (11, WARN), (301, FAIL)])
def test_a_deployment_on_aws_has_what_applies_there(aws, behind_s, level):
    # What was late four minutes ago has been caught up.
    for late_s, age_s in ((400, 240), (behind_s, 1)):
        put("IteratorAge", late_s * 1000, age_s, FunctionName="iort-Summarize")
    found = looked(doctor.of_cloud(Deployed(cloud_of(robot="car1").table)))
    assert list(found) == ["machine", "clock", "stacks", "robots", "summaries", "alarms"]
    assert "AWS runs this deployment, in eu-west-1" in found["machine"].text
    assert found["robots"].text == "0 of 1 are connected"
    assert found["summaries"].text.startswith(f"{behind_s}.0 s behind")
    assert found["summaries"].level == level
    assert bool(found["summaries"].todo) == (level != OK)


def test_the_load_that_a_machine_takes_is_told_from_what_it_does_now(aws):
    put("IteratorAge", 100, 1, FunctionName="iort-Summarize")
    for name, value in (("BatchesSummarized", 1200), ("SamplesSummarized", 60_000)):
        put(name, value, 120, Deployment="iort", Function="summarize")
    cloud = Deployed(cloud_of().table)
    told = ", 20.0 batches and 1,000 samples a second"
    assert looked(deployment.findings(cloud, 0.25))["summaries"].text.endswith(
        f"{told} of about 80 batches that this machine takes"
    )
    assert looked(deployment.findings(cloud, 0.01))["summaries"].text.endswith(told)


def test_stacks_that_are_not_there_end_the_look(aws):
    class Empty(Deployed):
        def output(self, noun, name):
            raise StationError(f"stack iort-{noun} is not deployed")

    found = looked(doctor.of_cloud(Empty(cloud_of().table)))
    assert found["stacks"].level == FAIL
    assert "`make deploy`" in found["stacks"].todo
    assert "robots" not in found


@pytest.fixture
def folder(tmp_path):
    """A kept cloud that was killed, with a certificate that should have been renewed."""
    folder = tmp_path / "cloud"
    folder.mkdir()
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    days = {"broker": 60, "files": 20, "page": -1}
    up = kept.Up(
        version=1,
        versions={"iort": "0.0.1"},
        started_s=time.time() - 7200,
        pids={"up": ended.pid, "emulator": os.getpid()},
        ports={},
        listen=[],
        page=[],
        certificates=[
            kept.Certificate(name=name, file="", hosts=["10.0.0.1"], ends_s=time.time() + left * DAY_S)
            for name, left in days.items()
        ],
        ledger=str(folder / "ledger.db"),
        power_cut=False,
    )
    (folder / kept.UP).write_text(up.text())
    (folder / kept.CLOUD).write_text("{}")
    return folder


def test_a_cloud_that_was_killed_is_told_from_one_that_was_stopped(folder):
    found = looked(doctor.of_kept(folder))
    assert found["processes"].level == FAIL
    assert "were killed" in found["processes"].text
    levels = {name: found[f"certificate of {name}"].level for name in ("broker", "files", "page")}
    assert levels == {"broker": OK, "files": WARN, "page": FAIL}
    assert (found["backup"].level, found["backup"].todo) == (WARN, "`iort backup FILE`, to another disk")
    # Servers that cannot run are not asked.
    assert not {"servers", "version", "memory", "stacks"} & found.keys()
    (folder / kept.CLOUD).unlink()
    assert "were stopped" in looked(doctor.of_kept(folder))["processes"].text
    # Somebody holds the folder, and one of its processes has ended.
    with held(folder):
        assert looked(doctor.of_kept(folder))["processes"].level == FAIL
    (folder / kept.UP).unlink()
    found = looked(doctor.of_kept(folder))
    assert "no cloud is up" in found["processes"].text
    # It may be why.
    assert "GB free" in found["disk"].text


@pytest.mark.parametrize(("free", "level"), [(6e9, OK), (4e9, WARN), (4e8, FAIL)])
def test_a_disk_that_fills_up_is_told_before_it_is_full(folder, monkeypatch, free, level):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    disk = looked(doctor.of_kept(folder))["disk"]
    assert disk.level == level
    assert f"{free / 1e9:.1f} GB free" in disk.text


class Refusing:
    """A cloud that cannot write, and whose reads are refused beside writes."""

    namespace = "iort"

    def output(self, noun, _name):
        raise StationError(f"stack iort-{noun} cannot be read: ServiceUnavailable: disk is full")


@pytest.mark.parametrize(("free", "advice"), [(1e8, "free some of the disk"), (1e9, "deploy them")])
def test_a_full_disk_is_the_only_advice_while_calls_are_refused(folder, monkeypatch, free, advice):
    up = json.loads((folder / kept.UP).read_text()) | {"pids": {"emulator": os.getpid()}}
    (folder / kept.UP).write_text(json.dumps(up))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    monkeypatch.setattr(doctor.Cloud, "load", lambda _: Refusing())
    monkeypatch.setattr(doctor.kept, "owner", lambda _: os.getpid())
    monkeypatch.setattr(doctor, "_addresses", lambda _: [])
    monkeypatch.setattr(doctor, "_emulator", lambda _: iter(()))
    found = looked(doctor.of_kept(folder))
    assert found["stacks"].todo.startswith(advice)
    assert "free some of it" in found["disk"].todo


@pytest.mark.parametrize(("robots", "level"), [(200, OK), (275, OK), (325, WARN), (375, WARN)])
def test_a_load_is_told_before_summaries_fall_behind(monkeypatch, robots, level):
    # As measured: of 3.7 ms of a processor for a batch, the emulator takes 2.15 ms; 375 robots keep up.
    spent_s = {1: 0.00215 * robots, 2: 0.00155 * robots}
    passed = iter([0.0, 1.0])
    monkeypatch.setattr(doctor.time, "monotonic", lambda: next(passed))
    monkeypatch.setattr(doctor.time, "sleep", lambda _s: None)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    told = {pid: iter([0.0, seconds]) for pid, seconds in spent_s.items()}
    facts = {
        "family": lambda _pid: [1, 2],
        "memory": lambda: SimpleNamespace(total=24e9, available=20e9),
        "resident_bytes": lambda _pid: 1e8,
        "processor_s": lambda pid: next(told[pid]),
    }
    for name, fact in facts.items():
        monkeypatch.setattr(doctor, name, fact)
    found = looked(doctor._emulator(1))
    assert found["load"].level == level


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="needs Linux' /proc")
def test_the_facts_of_a_process_and_of_its_children():
    # It is busy until its processor time shows.
    code = (
        "import time; x = bytearray(50_000_000)\nwhile time.process_time() < 0.1: pass\nprint(1, flush=True)"
    )
    command = [sys.executable, "-c", f"{code}; input()"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        assert {os.getpid(), child.pid} <= set(doctor.family(os.getpid()))
        assert doctor.resident_bytes(child.pid) > 50_000_000
        assert doctor.processor_s(child.pid) >= 0.08
        child.communicate(b"\n")
    assert doctor.family(child.pid) == []
    assert doctor.resident_bytes(child.pid) == doctor.processor_s(child.pid) == 0
    assert not doctor.runs(child.pid)
    assert doctor.memory().total > doctor.memory().available > 0
    assert doctor.clock_is_set() in (True, False)


@pytest.mark.parametrize(("told", "level"), [(6, OK), (8, WARN), ("{", WARN)])
def test_an_old_backup_is_told(folder, told, level):
    made = {"made_s": time.time() - told * DAY_S, "file": "/mnt/cloud.tar"} if told != "{" else None
    (folder / LAST_BACKUP).write_text(json.dumps(made) if made else told)
    assert looked(doctor.of_kept(folder))["backup"].level == level


def test_a_cloud_of_another_release_is_told(folder):
    up = kept.Up.load(folder)
    assert doctor._version(up).level == WARN
    assert doctor._version(replace(up, versions={"iort": version("iort-station")})).level == OK
