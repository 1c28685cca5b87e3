"""A robot exceeds its share of Lambda 2: other robots do not wait, its messages are kept, and it is
notified.
"""

from __future__ import annotations

import json
import threading
import time

import pytest

from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import OVER_SHARE, SECOND
from iort_contract.topics import record_topic
from iort_station.data.recorded import summary_table, topic_of
from iort_station.fleet import control
from iort_station.operations import audit
from testkit.mqtt import Robot
from testkit.waiting import until
from testkit.worst_case import worst_batches

pytestmark = pytest.mark.heavy

S = 1_000_000
GOOD = 8


def seconds_of(embedded, robot):
    """Return a robot's summarised seconds, in the order of a query."""
    pages = summary_table(embedded.cloud).pages(topic_of(embedded.cloud, robot, VESC_STREAM))
    return [int(item[SECOND]["N"]) for page in pages for item in page.items]


@pytest.mark.parametrize(("rate_hz", "count"), [(15, 40), (100, 80)])
def test_expensive_batches_of_one_robot_do_not_delay_other_robots(embedded, bundle, iort, rate_hz, count):
    bad, good = bundle("bad"), bundle("good")
    messages = list(worst_batches(count))
    topics = {car: record_topic(car.robot, VESC_STREAM, embedded.namespace) for car in (bad, good)}
    t_us = int(time.time()) * S
    with Robot(bad.folder) as hostile, Robot(good.folder) as other:
        hostile.online()
        other.online()
        began, waiting = time.monotonic(), threading.Event()
        for n, message in enumerate(messages):
            hostile.publish(topics[bad], message)
            if n % (count // GOOD) == 0:
                seq = n // (count // GOOD)
                batch = Batch("0badcafe", seq, [t_us + seq * S], {"speed": [seq]})
                other.publish(topics[good], encode_batch(batch))
            waiting.wait(max(0.0, began + (n + 1) / rate_hz - time.monotonic()))
    first = t_us // S
    expected = list(range(first, first + len(range(0, count, count // GOOD))))
    until(lambda: len(seconds_of(embedded, good.robot)) == len(expected))
    assert seconds_of(embedded, good.robot) == expected
    over = until(lambda: control.over_share(embedded.cloud, bad.robot))
    assert over.batches > 0
    assert control.over_share(embedded.cloud, good.robot) is None
    shown = json.loads(iort("robots", "show", bad.robot, "--json").stdout)
    assert shown[OVER_SHARE]["batches"] >= over.batches
    stored = list(audit.batches(embedded.cloud, bad.robot, VESC_STREAM))
    assert [batch.seq for batch in stored] == list(range(count))
    # After the robot has stopped, the waiting batches are summarised automatically.
    until(lambda: len(seconds_of(embedded, bad.robot)) >= count, within_s=600)
    assert [s - first for s in seconds_of(embedded, good.robot)] == list(range(len(expected)))
