"""The bridge on the embedded cloud: a car that is woken by a subscription, its past, and a panel that drives
it, by a client that is not ours."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from iort_station import data
from iort_station.cloud import EMBEDDED
from iort_station.operations import audit
from local.demo import DOWNLINK
from testkit.waiting import until
from tests.bridge.judge import Judge
from tests.local.data.drives import Agent


@contextmanager
def bridge(folder: Path, *arguments: str) -> Iterator[dict[str, Any]]:
    """`iort bridge` in a process, with what it says of itself; it ends by Ctrl-C."""
    iort = [str(Path(sys.executable).parent / "iort"), "--local", "--embedded", str(folder / EMBEDDED.name)]
    command = [*iort, "bridge", *arguments, "--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            line = process.stdout.readline()
            assert line, process.stderr.read()
            yield json.loads(line)
        finally:
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors


@pytest.fixture
def car(bundle: Any) -> Any:
    return bundle(sources=[{"type": "sim", "rate_hz": 50}], ping={"rate_hz": 5}, downlink=DOWNLINK)


def test_a_subscription_wakes_a_car_and_its_end_lets_it_sleep_and_the_past_is_what_was_seen(
    embedded: Any, car: Any
) -> None:
    cloud, robot = embedded.cloud, car.robot
    with Agent(car) as agent:
        until(agent.status)

        def viewers() -> int:
            return int(agent.told()["lanes"]["live"]["viewers"])

        until(lambda: list(audit.batches(cloud, robot, "vesc")))
        until(lambda: list(audit.batches(cloud, robot, "pose")))
        with bridge(embedded.folder, robot) as served, Judge(served["url"]) as judge:
            assert viewers() == 0
            assert "clientPublish" not in judge.of("server")[0]["info"]["capabilities"]
            schema = json.loads(judge.topics["/iort/vesc"]["schema"])
            assert schema["properties"]["voltage_input"]["description"].startswith("V: ")
            judge.do("subscribe", topic="/iort/vesc")
            until(lambda: viewers() == 1)
            seen = until(lambda: len(got := list(judge.got("/iort/vesc"))) >= 20 and got)
            judge.do("unsubscribe", topic="/iort/vesc")
            until(lambda: viewers() == 0)
        first_ns, last_ns = seen[0].t_ns, seen[-1].t_ns
    stored = data.query(cloud, robot, "vesc", first_ns // 1000, last_ns // 1000 + 1)
    columns = {name: data.values(column) for name, column in stored.columns.items()}
    recorded = {
        t_us * 1000: {name: column[i] for name, column in columns.items()}
        for i, t_us in enumerate(stored.times_us.tolist())
    }
    assert [one.fields for one in seen] == [recorded[one.t_ns] for one in seen]

    begin = f"{first_ns // 1000 / 1e6:.6f}"
    with bridge(embedded.folder, robot, "--last", "1h") as served, Judge(served["url"]) as judge:
        assert begin
        judge.do("subscribe", topic="/iort/vesc")
        began = judge.play("play", seek_ns=first_ns, speed=10.0)
        until(lambda: any(one.t_ns > last_ns for one in judge.got("/iort/vesc", after=began)) or _over(judge))
        played = {one.t_ns: one.fields for one in judge.got("/iort/vesc", after=began) if one.t_ns <= last_ns}
    assert played == recorded


def _over(judge: Judge) -> bool:
    return judge.of("state")[-1]["status"] == 3


def test_what_cannot_be_served_is_said_in_a_line(iort: Any, car: Any, tmp_path: Path) -> None:
    for arguments, words in (
        (["nobody"], "nobody"),
        ([car.robot, "--last", "1m"], "it has sent nothing yet"),
        ([car.robot, "--last", "1m", "--drive"], "the past cannot be driven"),
        (["--drive"], "--drive needs the name of one robot"),
        ([str(tmp_path / "no.mcap")], "must be an MCAP file"),
        ([car.robot, "--incident", "0badcafe"], "give robots with a range"),
        (["--incident", "0badcafe"], "no incident 0badcafe"),
    ):
        done = iort("bridge", *arguments, "--port", "0")
        assert done.exit_code == 1, arguments
        assert words in str(done.exception), arguments
