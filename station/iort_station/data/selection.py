"""A selection: which samples and fields of a stream a query asks for.

Conditions and derived fields are evaluated over numpy columns, with the same results as
`iort_contract.expression`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Column, values
from iort_contract import expression
from iort_contract.catalog.derived import SOURCES, Vehicle, calculable
from iort_contract.expression import ExpressionError, MismatchError, Node
from iort_contract.limits import ContractError
from iort_contract.topics import check_robot, check_stream
from iort_station.errors import StationError, UsageError
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

    def wanted(self) -> Callable[[str], bool]:
        """Which stored fields the answer needs."""
        if self.fields is None:
            return lambda _name: True
        named = self.named()
        return named.union(*(SOURCES[name] for name in named & SOURCES.keys())).__contains__

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


Columns: TypeAlias = Mapping[str, Column]


def holds(node: Node, columns: Columns, n: int) -> NDArray[np.bool_]:
    """A mask of the ``n`` samples that meet a condition; a missing field is null.

    Raises `StationError` if the condition compares a number with a text.
    """
    fields = {name: columns.get(name) for name in expression.names(node)}
    if _has_text(node) or any(column is not None and column.dtype == object for column in fields.values()):
        lists = {name: values(column) for name, column in fields.items() if column is not None}
        try:
            return np.array(expression.holds(node, lists, n), dtype=np.bool_)
        except MismatchError as error:
            raise StationError(f"the condition cannot be evaluated: {error}") from error
    null = np.full(n, np.nan)
    numbers = {name: null if column is None else column.astype(float) for name, column in fields.items()}
    with np.errstate(all="ignore"):
        return _truth(expression.evaluate(node, numbers, _ARRAYS), n)


def derive(columns: Columns, vehicle: Vehicle | None) -> dict[str, Column]:
    """The derived fields, as `iort_contract.catalog.derived.derive` computes them from lists."""
    numbers = {name: column for name, column in columns.items() if column.dtype.kind == "f"}
    with np.errstate(all="ignore"):
        return {
            entry.name: _finite(
                entry.formula(**{name: numbers[name] for name in SOURCES[entry.name]}, **parameters)
            )
            for entry, parameters in calculable(numbers, vehicle)
        }


def _finite(column: Column) -> Column:
    column[~np.isfinite(column)] = np.nan
    return column


def _has_text(node: Node) -> bool:
    if isinstance(node, expression.Constant):
        return isinstance(node.value, str)
    return any(map(_has_text, expression.children(node)))


# An array of numbers has NaN for null; a mask is an array of truths.
def _numbers(value: Any) -> Column:
    return np.asarray(value, dtype=float)


def _calculated(symbol: str, left: Any, right: Any) -> Column:
    result = expression.ARITHMETIC[symbol](_numbers(left), _numbers(right))
    return np.where(_numbers(right) == 0, np.nan, result) if symbol in "/%" else np.asarray(result)


def _compared(symbol: str, left: Any, right: Any) -> Any:
    left, right = _numbers(left), _numbers(right)
    # NaN makes all other comparisons false by itself.
    known = ~(np.isnan(left) | np.isnan(right)) if symbol == "!=" else True
    return expression.COMPARISONS[symbol](left, right) & known


def _truth(value: Any, n: int | None = None) -> NDArray[np.bool_]:
    value = np.asarray(value)
    mask = value if value.dtype == np.bool_ else (value != 0) & ~np.isnan(value)
    return np.asarray(mask if n is None else np.broadcast_to(mask, (n,)), dtype=np.bool_)


_ARRAYS = expression.Calculus(
    _calculated,
    lambda value: np.abs(_numbers(value)),
    _compared,
    lambda value: np.isnan(_numbers(value)),
    _truth,
)
