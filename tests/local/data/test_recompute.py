"""A car was registered with the wrong gain: a correction also corrects its summaries, on the embedded
cloud.
"""

from __future__ import annotations

import json
import time

import pytest

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.topics import record_topic
from iort_station import data
from iort_station.fleet import registry
from iort_station.operations import audit, recompute
from iort_station.operations.recompute import Recomputed
from testkit.mqtt import Robot
from testkit.waiting import until

RUN = "0badcafe"
SECONDS = 6


def drive(embedded, car, stream="vesc"):
    """Store six one-second batches, summarised with the F1TENTH's gain; return their start."""
    start_us = (int(time.time()) - 3600) * 1_000_000
    with Robot(car.folder) as robot:
        robot.online()
        for i in range(SECONDS):
            times = [start_us + i * 1_000_000 + k * 100_000 for k in range(10)]
            batch = Batch(RUN, i, times, {"speed": [1060.0 * i] * 10, "duty_cycle": [0.1 * i] * 10})
            topic = record_topic(car.robot, stream)
            assert robot.publish(topic, encode_batch(batch)) == "SUCCESS"
    until(lambda: audit.samples_summarized(embedded.cloud, car.robot, stream) == 10 * SECONDS)
    return start_us


def speeds(embedded, robot, stream="vesc"):
    found = data.query(embedded.cloud, robot, stream, summary=True, fields=["speed_mps"])
    return found.columns["speed_mps_max"].tolist()


def test_a_corrected_gain_applies_to_queries_and_summaries(embedded, bundle, iort):
    cloud, car = embedded.cloud, bundle()
    start_us = drive(embedded, car)
    old = [1060 * i / 4614 for i in range(SECONDS)]
    assert speeds(embedded, car.robot) == pytest.approx(old)
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(start_us // 1_000_000 + 2))
    done = iort("robots", "set", car.robot, "speed_to_erpm_gain=1060", "--from", at, "--no-wait")
    assert done.exit_code == 0, done.output
    assert "speed_to_erpm_gain 1060, was 4614" in done.stdout
    assert "vesc: 4 seconds recomputed" in done.stdout
    assert speeds(embedded, car.robot) == pytest.approx([*old[:2], 2, 3, 4, 5])
    # Lambda 2 answers with the new gain for every reader, every time.
    for on in ("client", "lambda"):
        found = data.query(cloud, car.robot, "vesc", fields=["speed_mps"], on=on)
        assert found.columns["speed_mps"][::10].tolist() == pytest.approx(range(SECONDS))
    for _ in range(2):
        assert recompute.recompute(cloud, car.robot, "vesc", None) == Recomputed(SECONDS, 0)
        assert speeds(embedded, car.robot) == pytest.approx(range(SECONDS))
    assert registry.vehicle_of(cloud, car.robot).speed_to_erpm_gain == 1060
    # Later samples have the new gain, too.
    drive(embedded, car, "esc")
    assert speeds(embedded, car.robot, "esc") == pytest.approx(range(SECONDS))


@pytest.mark.parametrize(
    ("parameter", "said"),
    [
        ("speed_to_erpm_gain=0", "not 0, got 0"),
        ("speed_to_erpm_gain=fast", "must be PARAMETER=NUMBER, got 'speed_to_erpm_gain=fast'"),
        ("online=1", "got online"),
    ],
)
def test_an_invalid_parameter_changes_nothing(embedded, bundle, iort, parameter, said):
    car = bundle()
    before = registry.get(embedded.cloud, car.robot)
    done = iort("robots", "set", car.robot, parameter)
    assert done.exit_code == 1
    assert said in str(done.exception)
    assert registry.get(embedded.cloud, car.robot) == before
    assert "not registered" in str(iort("robots", "set", "nobody", "speed_to_erpm_gain=1").exception)


def test_what_only_the_analysis_needs_is_set_at_once_and_shown(embedded, bundle, iort):
    car = bundle()
    done = iort("robots", "set", car.robot, "capacity_ah=5", "cells=3")
    assert done.exit_code == 0, done.output
    assert "recomputed" not in done.output
    shown = json.loads(iort("robots", "show", car.robot, "--json").stdout)
    assert (shown["capacity_ah"], shown["cells"]) == (5.0, 3.0)
