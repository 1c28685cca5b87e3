"""`iort trace` of a driving car on the embedded cloud."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from iort_station.operations import trace
from local.deployment import ROOT
from testkit.waiting import GUARD_S, until
from tests.local.data.drives import Agent


def _trace(embedded, *arguments):
    command = [Path(sys.executable).parent / "iort", "--local", "--embedded", embedded.folder / "cloud.json"]
    return subprocess.run(
        [*command, "trace", *arguments, "--json"],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=GUARD_S,
    )


def test_the_trace_shows_every_hop_of_a_driving_car(embedded, bundle):
    car = bundle(
        sources=[{"type": "sim", "stream": "vesc", "rate_hz": 20}],
        ping={"rate_hz": 5},
        metrics={"every_s": 1},
    )
    with Agent(car) as agent:
        until(agent.status)
        done = _trace(embedded, car.robot, "--updates", "10", "--seconds", "60")
        # The same car, by the way without PubNub.
        straight = _trace(embedded, car.robot, "--updates", "10", "--seconds", "60", "--live", "iot")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["updates"] == 10
    names = [hop["name"] for hop in found["hops"]]
    assert len(names) == len(set(names)) == 5
    # All hops share one clock here: a message cannot arrive before it has left.
    for hop in found["hops"]:
        assert hop["p50_ms"] >= -1.0 - (hop["uncertainty_ms"] or 0.0), hop
    assert found["whole"]["p50_ms"] > 0
    assert straight.returncode == 0, straight.stderr
    found = json.loads(straight.stdout)
    assert [hop["name"] for hop in found["hops"]] == [trace.CAR, trace.BROKER]
    assert found["whole"]["p50_ms"] > 0


def test_the_trace_reports_an_idle_car(embedded, bundle):
    done = _trace(embedded, bundle().robot, "--seconds", "0.5")
    assert done.returncode == 1
    assert "is it driving" in done.stderr
