"""Metrics of SQS.

AWS: counts the messages that wait in each queue, every minute
  (https://docs.aws.amazon.com/AWSSimpleQueueService/latest/SQSDeveloperGuide/sqs-available-cloudwatch-metrics.html).
ministack: does not count them.
Test: tests/local/operations/test_metrics.py::test_waiting_messages_are_counted
Patch: none; ministack has no clock that could count
"""

from __future__ import annotations

import inspect

from ministack.services import cloudwatch, sqs

from local.gaps.metrics import alarm_timer
from local.gaps.parts.points import record


def install() -> None:
    """Close the gap in this process: `alarm_timer` counts each time that it looks."""
    alarm_timer.BEFORE_ALARMS.append(count)


def is_open() -> bool:
    """Look at the source: no wait shows that nobody counts."""
    return not any('"AWS/SQS", "Approx' in inspect.getsource(module) for module in (sqs, cloudwatch))


def count() -> None:
    """Record how many messages wait in each queue."""
    for queue in list(sqs._queues.values()):
        sqs._refresh_counts(queue)
        waiting = float(queue["attributes"]["ApproximateNumberOfMessages"])
        name = queue["attributes"]["QueueArn"].rsplit(":", 1)[-1]
        record("AWS/SQS", "ApproximateNumberOfMessagesVisible", waiting, "Count", QueueName=name)
