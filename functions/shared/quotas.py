"""What a robot may use: a count of a day or an hour in its row of the registry, a token bucket in memory."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from iort_contract.tables import ROBOT

if TYPE_CHECKING:
    from types_boto3_dynamodb import DynamoDBClient

# Periods in UTC, as the row names them.
DAY, HOUR = "%Y-%m-%d", "%Y-%m-%dT%H"


class Quota:
    """Counts in each ``period``, which is `DAY` or `HOUR`, towards the ``most`` that a robot may use.

    ``named`` are the attributes of the robot's row: the period that is counted, and the count.
    """

    def __init__(
        self, client: DynamoDBClient, *, table: str, named: tuple[str, str], period: str, most: int
    ) -> None:
        self._client, self._table, self._period, self.most = client, table, period, most
        self._names = {"#period": named[0], "#count": named[1], "#robot": ROBOT}

    def take(self, robot: str, amount: int, now_s: float) -> bool:
        """Count the amount and return True if it fits in this period's quota. An unregistered robot has
        none."""
        if amount > self.most:
            return False
        left = {":left": {"N": str(self.most - amount)}}
        return self._add(robot, amount, now_s, " AND #count <= :left", left) is not None

    def count(self, robot: str, amount: int, now_s: float) -> int:
        """Count the amount; return what the period has now, 0 for an unregistered robot."""
        return self._add(robot, amount, now_s) or 0

    def _add(
        self, robot: str, amount: int, now_s: float, fits: str = "", left: Mapping[str, Any] | None = None
    ) -> int | None:
        now = {"S": time.strftime(self._period, time.gmtime(now_s))}
        values = {":now": now, ":amount": {"N": str(amount)}}
        count = self._update(robot, "ADD #count :amount", f"#period = :now{fits}", {**values, **(left or {})})
        if count is not None:
            return count
        another = "attribute_exists(#robot) AND (attribute_not_exists(#period) OR #period <> :now)"
        return self._update(robot, "SET #period = :now, #count = :amount", another, values)

    def _update(self, robot: str, change: str, condition: str, values: Mapping[str, Any]) -> int | None:
        """The count after the change; None if the condition does not hold."""
        try:
            answer = self._client.update_item(
                TableName=self._table,
                Key={ROBOT: {"S": robot}},
                UpdateExpression=change,
                ConditionExpression=condition,
                ExpressionAttributeNames={k: v for k, v in self._names.items() if k in change + condition},
                ExpressionAttributeValues=values,
                ReturnValues="UPDATED_NEW",
            )
        except self._client.exceptions.ConditionalCheckFailedException:
            return None
        return int(answer["Attributes"][self._names["#count"]]["N"])


# Robots beyond this number have spent nothing worth keeping.
_ROBOTS = 10_000


class RateLimiter:
    """Each robot may spend ``burst`` at once, and ``a_second`` more with every second. Robots share nothing.

    It keeps the ten thousand robots that spent last. It is safe for several threads.
    """

    def __init__(self, *, burst: float, a_second: float) -> None:
        self._burst, self._a_second = burst, a_second
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def left(self, robot: str, now_s: float) -> float:
        """The robot's remaining allowance; negative after overspending."""
        left, at_s = self._left.get(robot, (self._burst, now_s))
        # A clock that is set back takes nothing away.
        return min(self._burst, left + self._a_second * max(0.0, now_s - at_s))

    def spend(self, robot: str, now_s: float, amount: float) -> float:
        """Spend an amount; return the rest."""
        with self._lock:
            left = self.left(robot, now_s) - amount
            # After a clock was set back, the same seconds must not count twice.
            _, at_s = self._left.get(robot, (0.0, now_s))
            self._left[robot] = (left, max(at_s, now_s))
            self._left.move_to_end(robot)
            if len(self._left) > _ROBOTS:
                self._left.popitem(last=False)
        return left
