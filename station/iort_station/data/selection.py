"""A selection: which samples and fields of a stream a query asks for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from iort_contract import expression
from iort_contract.catalog.derived import SOURCES
from iort_contract.expression import ExpressionError, Node
from iort_contract.limits import ContractError
from iort_contract.topics import check_robot, check_stream
from iort_station.errors import UsageError
from iort_station.times import Time, time_us


@dataclass(frozen=True, kw_only=True)
class Selection:
    """A stream's samples from ``start_us`` (inclusive) to ``end_us`` (exclusive) that meet a condition.

    ``fields`` are the fields to return; None means all. ``where`` is the condition's text.
    """

    robot: str
    stream: str
    start_us: int | None = None
    end_us: int | None = None
    fields: tuple[str, ...] | None = None
    where: str | None = None
    condition: Node | None = field(default=None, repr=False)

    def named(self) -> frozenset[str]:
        """The fields that the selection names, in its list or in its condition."""
        deciding = expression.names(self.condition) if self.condition is not None else frozenset()
        return deciding.union(self.fields or ())

    def needs(self, name: str) -> bool:
        """Whether the answer needs this stored field."""
        if self.fields is None:
            return True
        named = self.named()
        return name in named or any(name in sources for made, sources in SOURCES.items() if made in named)

    def holds_time(self, t_us: int) -> bool:
        """Whether the range includes a time."""
        return (self.start_us is None or self.start_us <= t_us) and (
            self.end_us is None or t_us < self.end_us
        )


def select(
    robot: str,
    stream: str,
    start: Time | None = None,
    end: Time | None = None,
    *,
    fields: Sequence[str] | None = None,
    where: str | None = None,
) -> Selection:
    """Make a selection from times and a condition as people write them; raises `UsageError`."""
    now_us = time.time_ns() // 1000
    try:
        check_robot(robot)
        check_stream(stream)
        condition = expression.parse(where) if where is not None else None
    except (ContractError, ExpressionError) as error:
        raise UsageError(str(error)) from error
    start_us = None if start is None else time_us(start, now_us)
    end_us = None if end is None else time_us(end, now_us)
    if start_us is not None and end_us is not None and start_us > end_us:
        raise UsageError("the range ends before it starts")
    return Selection(
        robot=robot,
        stream=stream,
        start_us=start_us,
        end_us=end_us,
        fields=None if fields is None else tuple(dict.fromkeys(fields)),
        where=where,
        condition=condition,
    )
