"""Gives new samples of the stream `incidents` to the function `incident`, which tells of them."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import fields
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared.quotas import RateLimiter
from iort_contract.limits import Value
from iort_contract.messages.batch import Batch
from iort_contract.messages.recorder import Incident
from iort_contract.tables import INCIDENT, T_US, TOPIC
from iort_contract.topics import parse_topic

_log = logging.getLogger(__name__)
# Samples of a robot that are told of: after an outage many come at once, and no trigger fires as often as a
# hostile robot may say.
BURST, A_SECOND = 200.0, 0.1
_FIELDS = [field.name for field in fields(Incident)]
# An event has bounds, and a robot's text has none.
_MOST_TEXT = 1000


class Announcer:
    """Calls ``function``, and waits for none of its answers."""

    def __init__(
        self, client: Callable[[], Any], function: str, clock: Callable[[], float] = time.time
    ) -> None:
        self._client, self._function, self._clock = client, function, clock
        self._limiter = RateLimiter(burst=BURST, a_second=A_SECOND)

    def announce(self, topic: str, batches: Iterable[Batch]) -> list[Batch]:
        """Give each sample to the function; return the batches that it did not get whole. After one, none is
        tried: everybody's samples wait."""
        left = list(batches)
        while left and self._give(topic, left[0]):
            del left[0]
        return left

    def _give(self, topic: str, batch: Batch) -> bool:
        robot, now_s = parse_topic(topic).robot, self._clock()
        for place, t_us in enumerate(batch.times_us):
            if self._limiter.left(robot, now_s) < 1:
                _log.warning("%s has more incidents than are told of; the table has them all", robot)
                return True
            self._limiter.spend(robot, now_s, 1)
            columns = {name: batch.columns[name] for name in _FIELDS if name in batch.columns}
            sample = {name: _short(column[place]) for name, column in columns.items()}
            event = {TOPIC: topic, T_US: t_us, INCIDENT: sample}
            payload = json.dumps(event, separators=(",", ":")).encode()
            try:
                self._client().invoke(FunctionName=self._function, InvocationType="Event", Payload=payload)
            except (BotoCoreError, ClientError) as error:
                _log.warning("an incident of %s is told later: %s", robot, error)
                return False
        return True


def _short(value: Value) -> Value:
    return value[:_MOST_TEXT] if isinstance(value, str) else value
