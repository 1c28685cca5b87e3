"""Alarms look by themselves.

AWS: evaluates an alarm once a period, whether data comes or not
  (https://docs.aws.amazon.com/AmazonCloudWatch/latest/monitoring/AlarmThatSendsEmail.html).
ministack: evaluates alarms only when somebody puts data, changes or describes one.
Test: tests/local/operations/test_eyes.py::test_a_fault_reaches_a_human_and_the_dashboards
Patch: none; ministack has no clock of its own
"""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable

from ministack.core.responses import set_request_region
from ministack.services import cloudwatch

from local.gaps.parts.points import forget_old

_TICK_S = 5.0
# What has to be recorded before the alarms are evaluated.
BEFORE_ALARMS: list[Callable[[], None]] = []


def install() -> None:
    """Nothing to wrap: `start` closes the gap once the emulator is configured."""


def is_open() -> bool:
    """Look at the source for a thread or a timer: no wait shows that nobody looks."""
    source = inspect.getsource(cloudwatch)
    return not any(word in source for word in ("Thread(", "create_task(", "call_later(", "Timer("))


def start(region: str) -> None:
    """Evaluate the alarms of a region every few seconds, as long as the process lives."""
    threading.Thread(target=_tick, args=(region,), daemon=True, name="cloudwatch").start()


def _tick(region: str) -> None:
    set_request_region(region)
    while True:
        time.sleep(_TICK_S)
        for each in BEFORE_ALARMS:
            each()
        cloudwatch._evaluate_all_alarms()
        forget_old()
