"""A robot's share of the processor in `summarize`. Batches beyond it wait for `later`,
and delay no other robot."""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from botocore.exceptions import BotoCoreError, ClientError

from functions.shared.queues import send_all
from functions.shared.quotas import RateLimiter
from iort_contract.limits import ContractError
from iort_contract.tables import BATCH, OVER_SHARE, PUT_OFF, PUT_OFF_LAST_MS, PUT_OFF_SINCE_MS, TOPIC
from iort_contract.topics import SHADOW, parse_topic

if TYPE_CHECKING:
    from types_boto3_iot_data import IoTDataPlaneClient
    from types_boto3_sqs import SQSClient

_log = logging.getLogger(__name__)
# CPU seconds of a robot: per second, and as a burst. A normal car takes a hundredth.
A_SECOND, BURST_S = 0.1, 0.3
# The cost of the requests for a topic, or for a refused batch, besides CPU time.
REQUESTS_S = 0.002
# The keys of a message. The dearest batch, of 60 s, takes 2.6 s of a processor with the seconds beside
# it, and the later function has 0.29 of one for 60 s.
KEYS = 4
# A robot is notified again after this time; after a longer time within its share, it is notified anew.
TELL_S, OVER_S = 30.0, 60.0
_ROBOTS = 1000

Change = Mapping[str, Any]


class OverShareError(Exception):
    """A robot is so far over its share that its batch has to wait."""


class Share:
    """What each robot may still use, by the arrival times of its batches in the table.

    The times and the topic, which names the robot, are the cloud's. One environment keeps the shares in
    memory; if several environments serve a shard, a robot has its share in each. ``spent_s`` returns the
    thread's CPU time.
    """

    def __init__(
        self,
        *,
        burst_s: float = BURST_S,
        a_second: float = A_SECOND,
        spent_s: Callable[[], float] = time.thread_time,
    ) -> None:
        self._burst_s, self._spent_s = burst_s, spent_s
        self._limiter = RateLimiter(burst=burst_s, a_second=a_second)

    @classmethod
    def unlimited(cls) -> Share:
        """A share without limit."""
        return cls(burst_s=math.inf)

    def over(self, robot: str, at_s: float) -> bool:
        """Whether the robot's next batch has to wait."""
        return self._limiter.left(robot, at_s) <= 0

    def meter(self, robot: str, at_s: float) -> Meter:
        """Measure this thread's work for a robot from now on."""
        return Meter(self._limiter, self._spent_s, robot, at_s, least_s=-self._burst_s)


class Meter:
    """Charges the work of the thread that created it to a robot."""

    def __init__(
        self,
        limiter: RateLimiter,
        spent_s: Callable[[], float],
        robot: str,
        at_s: float,
        *,
        least_s: float,
    ) -> None:
        self._limiter, self._spent_s = limiter, spent_s
        self._robot, self._at_s, self._least_s = robot, at_s, least_s
        self._from_s = spent_s()

    def charge(self, beside_s: float = 0.0) -> float:
        """Charge the work since the last call, plus ``beside_s``; return the rest."""
        before_s, self._from_s = self._from_s, self._spent_s()
        return self._limiter.spend(self._robot, self._at_s, self._from_s - before_s + beside_s)

    def check(self) -> None:
        """Charge, and raise `OverShareError` if the robot has spent its allowance twice. Work that began
        within the share is not given up for a small excess."""
        if self.charge() < self._least_s:
            raise OverShareError(self._robot)


def robot_of(topic: str) -> str:
    """The robot of a topic; "" for an invalid topic, whose batches are refused at no cost."""
    try:
        return parse_topic(topic).robot
    except ContractError:
        return ""


def robot_of_change(change: Change) -> str:
    """The robot of a changed item, by its key."""
    return robot_of(change["Keys"][TOPIC]["S"])


class PutOff:
    """The queue of waiting batches' keys; the telemetry table has the batches."""

    def __init__(self, client: SQSClient, queue_url: str) -> None:
        self._client, self._queue_url = client, queue_url

    def put(self, changes: Iterable[Change]) -> list[Change]:
        """Queue the batches; return those that the queue did not take."""
        by_robot: dict[str, list[Change]] = {}
        for change in changes:
            by_robot.setdefault(robot_of_change(change), []).append(change)
        groups = [
            (robot, several[start : start + KEYS])
            for robot, several in by_robot.items()
            for start in range(0, len(several), KEYS)
        ]
        # AWS recognises a noisy robot by its group, and serves the others first: "SQS fair queues".
        messages = [{"MessageBody": _message(several), "MessageGroupId": robot} for robot, several in groups]
        left = send_all(self._client, self._queue_url, messages)
        return [change for place in sorted(left) for change in groups[place][1]]


def _message(changes: Sequence[Change]) -> str:
    keys = [[change["Keys"][name]["S"] for name in (TOPIC, BATCH)] for change in changes]
    return json.dumps({PUT_OFF: keys})


def waiting(body: str) -> list[tuple[str, str]]:
    """Topic and batch of each entry of a queue message."""
    return [(topic, batch) for topic, batch in json.loads(body)[PUT_OFF]]


class Told:
    """Notifies robots in their shadow that they are over their share."""

    def __init__(self, client: IoTDataPlaneClient) -> None:
        self._client = client
        self._robots: dict[str, tuple[float, float, float, int]] = {}

    def tell(self, robot: str, batches: int, at_s: float) -> None:
        """Count waiting batches and notify the robot: at once, then at intervals."""
        since_s, last_s, told_s, before = self._robots.pop(robot, (at_s, at_s, -math.inf, 0))
        if at_s - last_s > OVER_S:
            since_s, told_s, before = at_s, -math.inf, 0
        count = before + batches
        if at_s - told_s >= TELL_S:
            _log.warning("%s is over its share of Lambda 2: %d batches wait for their summary", robot, count)
            self._update(robot, since_s, at_s, count)
            told_s = at_s
        self._robots[robot] = (since_s, at_s, told_s, count)
        if len(self._robots) > _ROBOTS:
            del self._robots[next(iter(self._robots))]

    def _update(self, robot: str, since_s: float, at_s: float, count: int) -> None:
        said = {PUT_OFF_SINCE_MS: int(since_s * 1000), PUT_OFF_LAST_MS: int(at_s * 1000), PUT_OFF: count}
        payload = json.dumps({"state": {"desired": {OVER_SHARE: said}}})
        try:
            self._client.update_thing_shadow(thingName=robot, shadowName=SHADOW, payload=payload)
        except (BotoCoreError, ClientError) as error:
            # A failure is harmless: the notice is only information.
            _log.warning("%s is not told that it is over its share: %s", robot, error)
