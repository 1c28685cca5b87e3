"""The stand-in for PubNub, tested with PubNub's JavaScript SDK."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import threading
from pathlib import Path

import pytest

from local.pubnub import PubNubStandIn
from testkit.ports import free_port
from tests.local.pubnub.pubnub_sdk import PAYLOADS, WAIT_S, publish

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def javascript():
    """Start the JavaScript SDK's subscriber; skip without Node or the package."""
    node = shutil.which("node")
    modules = Path(os.environ.get("IORT_NODE_MODULES") or ROOT / "node_modules")
    if node is None or not (modules / "pubnub").is_dir():
        pytest.skip("needs node and the npm package pubnub: run make setup")
    processes = []

    def start(standin, channel, count):
        script = Path(__file__).with_name("pubnub_subscriber.cjs")
        command = [node, script, modules / "pubnub", standin.origin, channel, str(count)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        watchdog = threading.Timer(WAIT_S, process.kill)
        watchdog.start()
        processes.append((process, watchdog))
        return process

    yield start
    for process, watchdog in processes:
        watchdog.cancel()
        process.kill()
        process.communicate()


def lines(process):
    for line in process.stdout:
        yield json.loads(line)


def test_the_javascript_sdk_receives_messages_from_python(standin, client, javascript):
    page = javascript(standin, "iort.*", len(PAYLOADS))
    printed = lines(page)
    assert next(printed) == {"status": "PNConnectedCategory"}
    publisher = client(standin)
    for payload in PAYLOADS:
        publish(publisher, "iort.car", payload)
    for payload in PAYLOADS:
        event = next(printed)
        assert (event["channel"], event["subscription"]) == ("iort.car", "iort.*")
        if payload != [1, [2.5, -0.1], 2**63, 1e308]:  # JavaScript's numbers are doubles.
            assert event["message"] == payload
    assert page.wait(WAIT_S) == 0


def test_the_javascript_sdk_reconnects_to_a_restarted_server(client, javascript):
    with PubNubStandIn(port=free_port()) as standin:
        page = javascript(standin, "iort.*", 2)
        printed = lines(page)
        assert next(printed) == {"status": "PNConnectedCategory"}
        publish(client(standin), "iort.car", "before")
        assert next(printed)["message"] == "before"
        standin.stop()
        with PubNubStandIn(port=standin.port) as restarted:
            publish(client(restarted), "iort.car", "after")
            seen = [next(printed)]
            while "message" not in seen[-1]:
                seen.append(next(printed, {"message": "nothing"}))
            assert seen[-1]["message"] == "after", seen
            assert page.wait(WAIT_S) == 0
