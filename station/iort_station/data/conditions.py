"""Conditions and derived fields over numpy columns, with the same results as `iort_contract.expression`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Column, values
from iort_contract import expression
from iort_contract.catalog.derived import SOURCES, Vehicle, calculable
from iort_contract.expression import (
    ARITHMETIC,
    COMPARISONS,
    Arithmetic,
    Comparison,
    Constant,
    Every,
    Field,
    IsNull,
    Magnitude,
    MismatchError,
    Node,
    Some,
)
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
        return _truth(_evaluate(node, numbers), n)


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
    if isinstance(node, Constant):
        return isinstance(node.value, str)
    if isinstance(node, Field):
        return False
    if isinstance(node, (Arithmetic, Comparison)):
        return _has_text(node.left) or _has_text(node.right)
    return any(map(_has_text, node.of if isinstance(node, (Every, Some)) else (node.of,)))


def _evaluate(node: Node, numbers: Mapping[str, Column]) -> Any:
    """An array of numbers with NaN for null, or a mask."""
    if isinstance(node, Field):
        return numbers[node.name]
    if isinstance(node, Constant):
        return float(node.value)
    if isinstance(node, Arithmetic):
        left, right = (np.asarray(_evaluate(side, numbers), dtype=float) for side in (node.left, node.right))
        result = ARITHMETIC[node.symbol](left, right)
        return np.where(right == 0, np.nan, result) if node.symbol in "/%" else result
    if isinstance(node, Magnitude):
        return np.abs(np.asarray(_evaluate(node.of, numbers), dtype=float))
    if isinstance(node, Comparison):
        left, right = (np.asarray(_evaluate(side, numbers), dtype=float) for side in (node.left, node.right))
        # NaN makes all other comparisons false by itself.
        known = ~(np.isnan(left) | np.isnan(right)) if node.symbol == "!=" else True
        return COMPARISONS[node.symbol](left, right) & known
    if isinstance(node, IsNull):
        return np.isnan(np.asarray(_evaluate(node.of, numbers), dtype=float))
    if isinstance(node, (Every, Some)):
        parts = [_truth(_evaluate(part, numbers)) for part in node.of]
        combine = np.logical_and if isinstance(node, Every) else np.logical_or
        mask = parts[0]
        for part in parts[1:]:
            mask = combine(mask, part)
        return mask
    return ~_truth(_evaluate(node.of, numbers))


def _truth(value: Any, n: int | None = None) -> NDArray[np.bool_]:
    value = np.asarray(value)
    mask = value if value.dtype == np.bool_ else (value != 0) & ~np.isnan(value)
    return np.asarray(mask if n is None else np.broadcast_to(mask, (n,)), dtype=np.bool_)
