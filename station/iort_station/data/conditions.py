"""Conditions and derived fields over numpy columns, with the same results as `iort_contract.expression`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Column, values
from iort_contract import expression
from iort_contract.catalog.derived import SOURCES, Vehicle, calculable
from iort_contract.expression import MismatchError, Node
from iort_station.errors import StationError

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
    if node.kind == expression.CONSTANT:
        return isinstance(node.value, str)
    return any(map(_has_text, node.of))


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


_ARRAYS = expression.operations(
    _calculated,
    _compared,
    lambda value: np.abs(_numbers(value)),
    lambda value: np.isnan(_numbers(value)),
    _truth,
)
