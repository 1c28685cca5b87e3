"""A robot that is none of our agents, written from docs/messages.md alone, on the embedded cloud."""

from __future__ import annotations

import ast
import json
import subprocess
import sys

from local.deployment import ROOT
from station import data, quarantine, registry
from station.listener import Listener
from tests.local.conftest import until

CLIENT = ROOT / "docs" / "examples" / "python_client.py"


def test_the_client_knows_none_of_our_code():
    imported = set()
    for node in ast.walk(ast.parse(CLIENT.read_text())):
        if isinstance(node, ast.Import):
            imported |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add(str(node.module).split(".")[0])
    assert imported - sys.stdlib_module_names == {"paho"}


def test_it_is_a_robot_as_any_other(embedded, bundle, iort):
    car = bundle()
    listening = Listener(robot=car.robot, namespace=embedded.namespace, **embedded.keys.reading())
    command = [sys.executable, CLIENT, car.folder]
    with (
        listening as listener,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client,
    ):
        said = [json.loads(client.stdout.readline()) for _ in range(2)]
        live = until(lambda: listener.heard)
        sent = iort("send", car.robot, "grip", '{"close": true}', "--valid-ms", "60000", "--seconds", "60")
        out, err = client.communicate(timeout=120)
    assert (client.returncode, err) == (0, "")
    assert sent.exit_code == 0, sent.output
    assert json.loads(out) == {"command": {"grip": {"close": True}}}
    ping, stored = said
    assert ping["round_trip_ms"] > 0

    found = until(lambda: data.query(embedded.cloud, car.robot, "arm", "-1h", "now"))
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
