"""A robot with a foreign client, written from docs/reference/messages.md alone, on the embedded cloud."""

from __future__ import annotations

import ast
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from iort_station.fleet import identity, registry, robots
from iort_station.operations import quarantine
from iort_station.page.pubnub import Listener
from local.deployment import ROOT
from testkit.waiting import GUARD_S, reached, until
from tests.local.conftest import recorded

EXAMPLES = ROOT / "docs" / "examples"
SMALL = EXAMPLES / "batch_and_live.py"
CLIENT, PROVISION = EXAMPLES / "python_client.py", EXAMPLES / "python_provision.py"


@pytest.mark.parametrize("example", [CLIENT, PROVISION, SMALL])
def test_the_examples_import_no_code_of_the_project(example):
    imported = set()
    for node in ast.walk(ast.parse(example.read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module).split(".")[0])
    assert imported - sys.stdlib_module_names <= {"paho", CLIENT.stem}


@pytest.fixture(params=["added", "claimed"])
def car(request, bundle, embedded, tmp_path):
    if request.param == "added":
        return bundle()
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed: apt install openssl")
    name, folder = f"foreign-{request.param}", tmp_path / "claim"
    identity.claim(embedded.cloud, name, out=folder)
    subprocess.run([sys.executable, PROVISION, folder, name], check=True, timeout=GUARD_S)
    return robots.Bundle(name, folder)


def test_a_foreign_client_works_like_any_robot(embedded, car, iort):
    listening = Listener(robot=car.robot, namespace=embedded.namespace, **embedded.keys.reading())
    # Its error output is in pytest's captured output.
    with (
        listening as listener,
        subprocess.Popen([sys.executable, CLIENT, car.folder], stdout=subprocess.PIPE, text=True) as client,
    ):
        said = [json.loads(client.stdout.readline()) for _ in range(2)]
        live = until(lambda: listener.heard)
        sent = iort("send", car.robot, "grip", '{"close": true}', "--valid-ms", "60000", "--seconds", "60")
        out, _ = client.communicate(timeout=GUARD_S)
    assert client.returncode == 0
    assert sent.exit_code == 0, sent.output
    assert json.loads(out) == {"command": {"grip": {"close": True}}}
    ping, stored = said
    assert ping["round_trip_ms"] > 0

    found = recorded(embedded, car.robot, "arm")
    assert found.columns["angle"].tolist()[:2] == [0.5, 1.5]
    assert found.columns["grip"].tolist() == [True, False, "x"]
    first_us, run, number = stored["batch"].split("-")
    assert (int(first_us), number) == (found.times_us[0], "0")
    assert (live[0].robot, live[0].stream, live[0].boot) == (car.robot, "arm", run)
    assert live[0].hops["offset_us"] == ping["offset_us"]
    body = embedded.cloud.client("s3").get_object(
        Bucket=embedded.cloud.output("storage", "FilesBucket"), Key=stored["key"]
    )["Body"]
    assert body.read() == car.config.read_bytes()
    assert not list(quarantine.entries(embedded.cloud, robot=car.robot))
    until(lambda: registry.get(embedded.cloud, car.robot)["online"] is False)


def python(_folder):
    return [sys.executable, SMALL]


def javascript(_folder):
    node = Path(sys.executable).with_name("node")
    if not node.exists() or not (ROOT / "node_modules" / "mqtt").exists():
        pytest.skip("needs node and the npm package mqtt: run make setup")
    return [node, SMALL.with_suffix(".mjs")]


def c(folder):
    source, program = SMALL.with_suffix(".c"), folder / "batch_and_live"
    if shutil.which("cc") is None or not Path("/usr/include/MQTTClient.h").exists():
        pytest.skip("needs a C compiler and paho: apt install gcc libpaho-mqtt-dev libssl-dev zlib1g-dev")
    command = ["cc", "-Wall", "-Werror", source, "-o", program, "-lpaho-mqtt3cs", "-lcrypto", "-lz"]
    subprocess.run(command, check=True)
    return [program]


@pytest.mark.parametrize("language", [python, javascript, c])
def test_a_small_client_stores_a_batch_and_shows_a_live_sample(language, embedded, bundle, tmp_path):
    client, car = language(tmp_path), bundle()
    endpoint = [embedded.cloud.mqtt_endpoint, str(embedded.cloud.mqtt_port)]
    command = [*client, *endpoint, car.robot, car.folder, car.folder / "root-ca.pem"]
    with Listener(robot=car.robot, namespace=embedded.namespace, **embedded.keys.reading()) as listener:

        def shown() -> list[Any]:
            # On a slow machine its only live message may be too old to be shown.
            subprocess.run(command, check=True, timeout=GUARD_S)
            reached(lambda: listener.heard, within_s=5)
            return listener.heard

        live = until(shown)[0]
    found = recorded(embedded, car.robot, "arm")
    assert found.columns["angle"].tolist()[:2] == [0.5, 1.5]
    assert (live.robot, live.stream, live.seq) == (car.robot, "arm", 0)
    assert not list(quarantine.entries(embedded.cloud, robot=car.robot))
