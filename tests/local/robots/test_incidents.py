"""Incidents on the embedded cloud: mail and webhook, a receiver that fails, and takes of findings; all with
the functions' own roles."""

from __future__ import annotations

import importlib.util
import json
import threading
import time
from collections import defaultdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from iort_contract.catalog.analysis import SERIOUS
from iort_contract.catalog.streams import INCIDENT_STREAM
from iort_contract.cloud import findings_key
from iort_contract.messages.analysis import DriveKey, Finding, encode_finding
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.messages.recorder import (
    FINDING,
    KEPT,
    LOST,
    UPLOADED,
    Incident,
    Trigger,
    decode_take,
    encode_trigger,
)
from iort_contract.topics import record_topic
from iort_station.cloud import invoke
from iort_station.fleet.control import Shadow
from iort_station.operations import quarantine
from local.deployment import ROOT
from testkit.mqtt import Robot
from testkit.waiting import until

RUN = "0badcafe"


class Receiver(BaseHTTPRequestHandler):
    """Answers an incident with 500 while its id is in ``failing``."""

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        content = json.loads(body)
        failing = content.get("id") in self.server.failing
        self.server.requests[content.get("id")].append((failing, dict(self.headers), body))
        self.send_response(500 if failing else 204)
        self.end_headers()

    def log_message(self, *_): ...


@pytest.fixture(scope="module")
def verified():
    """The receiver's check of docs/examples."""
    spec = importlib.util.spec_from_file_location("receiver", ROOT / "docs/examples/webhook_receiver.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.verified


@pytest.fixture
def receiver(iort):
    """A receiver whose address is the webhook, with its ``secret``."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
    server.requests, server.failing = defaultdict(list), set()
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    said = json.loads(iort("webhook", "set", f"http://127.0.0.1:{server.server_port}/hook", "--json").stdout)
    server.secret = said["secret"]
    yield server
    iort("webhook", "remove", "--yes")
    server.shutdown()
    thread.join()
    server.server_close()


def send(car, number, *states, seq=0):
    """Publish the samples of an incident as an agent does; return the incident's id."""
    t_us = time.time_ns() // 1000
    name = f"{number:016x}"
    one = Incident(name, "hardbrake", t_us - 30_000_000, t_us, KEPT, "current_input < -15")
    columns = {field: [value] * len(states) for field, value in one.sample().items()}
    batch = Batch(
        RUN, seq, [t_us + place for place in range(len(states))], {**columns, "state": list(states)}
    )
    with Robot(car.folder) as robot:
        robot.online()
        topic = record_topic(car.robot, INCIDENT_STREAM)
        assert robot.publish(topic, encode_batch(batch)) == "SUCCESS"
    return name


def test_an_incident_is_mailed_and_sent_signed_once(bundle, receiver, inbox, verified, iort):
    assert iort("webhook", "test").exit_code == 0
    car = bundle()
    name = send(car, 1, KEPT, UPLOADED)
    send(car, 1, KEPT, seq=1)
    until(lambda: len(receiver.requests[name]) >= 2, within_s=150)
    other = send(car, 2, LOST, seq=2)
    until(lambda: receiver.requests[other], within_s=150)
    assert sorted(json.loads(body)["state"] for _, _, body in receiver.requests[name]) == [KEPT, UPLOADED]
    for _, headers, body in (*receiver.requests[name], *receiver.requests[other]):
        assert verified(receiver.secret, headers, body)
        assert not verified("another", headers, body)
        assert json.loads(body)["robot"] == car.robot

    def subjects():
        return [m["Subject"].rpartition(", ")[2] for m in inbox() if car.robot in m["Subject"]]

    until(lambda: len(subjects()) >= 2)
    assert sorted(subjects()) == ["kept", "lost"]


def test_a_receiver_that_fails_is_asked_again_and_then_the_incident_is_in_quarantine(
    embedded, bundle, receiver, verified, iort
):
    car = bundle()
    receiver.failing.add(name := f"{7:016x}")
    assert send(car, 7, KEPT) == name
    (listed,) = until(lambda: list(quarantine.entries(embedded.cloud, robot=car.robot)), within_s=240)
    entry = quarantine.load(embedded.cloud, listed)
    assert "the webhook at 127.0.0.1 answered 500" in entry.reason
    assert json.loads(entry.payload)["incident"]["id"] == name
    # Three tries of three attempts, each signed anew.
    failed = receiver.requests[name]
    assert len(failed) == 9
    assert all(verified(receiver.secret, headers, body) for _, headers, body in failed[-3:])
    assert receiver.secret not in json.dumps([entry.reason, entry.payload.decode()])
    receiver.failing.clear()
    assert iort("replay-errors", "--robot", car.robot).exit_code == 0
    assert [failing for failing, *_ in receiver.requests[name][9:]] == [False]
    assert not list(quarantine.entries(embedded.cloud, robot=car.robot))


def test_a_new_finding_has_a_robot_with_a_trigger_on_findings_keep_its_time(embedded, bundle):
    cloud, car, other = embedded.cloud, bundle(), bundle("other")
    shadow, without = Shadow(cloud, car.robot), Shadow(cloud, other.robot)
    shadow.desire(encode_trigger(Trigger("found", on=FINDING, before_s=5, after_s=2)))
    t_us = time.time_ns() // 1000 - 60_000_000
    bucket, job = cloud.output("storage", "FilesBucket"), f"test-{time.time_ns()}"
    for robot in (car.robot, other.robot):
        drive = DriveKey(robot, t_us, RUN)
        found = Finding(
            drive, "cell_dropout", SERIOUS, "cell_dropout", t_us, t_us + 1, "vesc", (), "it drops"
        )
        content = {"drives": [{"drive": vars(drive), "findings": [encode_finding(found)]}], "gone": []}
        key, body = findings_key(job, robot), json.dumps(content).encode()
        cloud.client("s3").put_object(Bucket=bucket, Key=key, Body=body)
        for _ in range(2):
            asked = json.dumps({"job": job, "robot": robot}).encode()
            invoke(cloud, "analysis", "PresentFunction", asked, "Present")
    ((name, take),) = shadow.read().desired.recorder.takes.items()
    decoded = decode_take(name, take)
    assert (decoded.from_us, decoded.to_us) == (t_us - 5_000_000, t_us + 1 + 2_000_000)
    assert (decoded.by, decoded.why) == ("analysis", "cell_dropout: it drops")
    assert not without.read().desired.recorder.takes
