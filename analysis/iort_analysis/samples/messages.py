"""ROS messages of one type to columns, many at once: the numbers of messages of one form are arrays already.

The columns are those that `iort_contract.ros.columns.view` gives, which reads message by message, as happens
here to messages of rare forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iort_analysis.samples.blocks import Column, exact, objects, values
from iort_contract.checks import wire_column
from iort_contract.codec import EXACT
from iort_contract.limits import MAX_FIELD_CHARACTERS, MAX_FIELDS, ContractError, MessageError, Value
from iort_contract.ros.columns import view
from iort_contract.ros.definition import parse
from iort_contract.ros.message import Messages, RosType
from iort_contract.ros.places import Form, Place, Places

# Messages of more forms than these are read one by one.
_MOST_FORMS = 32
# An array of numbers of a letter of `struct`.
_TYPES = {letter: np.dtype(f"<{letter}") for letter in "bBhHiIqQfd"}
_TYPES["?"] = np.dtype("u1")


class Flat(NamedTuple):
    """Messages as columns. ``shapes`` are the names that some messages have, in order, and ``shape_of`` has
    each message's."""

    columns: dict[str, Column]
    shapes: Sequence[Sequence[str]]
    shape_of: NDArray[np.intp]


class Flattener:
    """Flattens the messages of one type."""

    def __init__(self, kind: RosType) -> None:
        self._kind = kind
        self._places: Places | None = None
        if kind.decoder is not None:
            self._places = Places(parse(kind.name, kind.definition))

    def flat(self, raws: Sequence[bytes]) -> Flat:
        """The messages' columns."""
        n = len(raws)
        parts: list[tuple[NDArray[np.intp], dict[str, Column]]] = []
        shapes: list[Sequence[str]] = []
        shape_of = np.zeros(n, dtype=np.intp)
        sizes = np.fromiter(map(len, raws), dtype=np.int64, count=n)
        rest = []
        for size in np.unique(sizes).tolist() if self._kind.decoder is not None else ():
            rows = np.flatnonzero(sizes == size)
            while len(rows):
                form = None if len(parts) >= _MOST_FORMS else self._form(raws[rows[0]])
                if form is None:
                    rest.append(rows[:1] if len(parts) < _MOST_FORMS else rows)
                    rows = rows[len(rest[-1]) :]
                    continue
                same, columns = _read(form, raws, rows, size)
                shape_of[same] = len(shapes)
                shapes.append(list(columns))
                parts.append((same, columns))
                rows = np.setdiff1d(rows, same, assume_unique=True)
        for row in np.concatenate(rest).tolist() if rest else ():
            found, _ = view(Messages(self._kind.id, self._kind.layout, [raws[row]]))
            shape_of[row] = len(shapes)
            shapes.append(list(found))
            own = {name: exact(column) for name, column in found.items()}
            parts.append((np.array([row]), own))
        if not parts:
            return Flat({}, [()], shape_of)
        return Flat(together(parts, n), shapes, shape_of)

    def _form(self, raw: bytes) -> Form | None:
        """The form of a message; None for one that is read by itself."""
        assert self._places is not None
        try:
            form = self._places.form(raw)
            texts = {name: text for name, text in form.fields.items() if not isinstance(text, Place)}
            for name, text in texts.items():
                wire_column(name, [text])
        except (MessageError, ContractError):
            return None
        fields = {name: place for name, place in form.fields.items() if len(name) <= MAX_FIELD_CHARACTERS}
        return None if len(fields) > MAX_FIELDS else form._replace(fields=fields)


def _read(
    form: Form, raws: Sequence[bytes], rows: NDArray[np.intp], size: int
) -> tuple[NDArray[np.intp], dict[str, Column]]:
    """Which of these messages, all of one size, have the form of the first; and their columns."""
    chosen = [raws[row] for row in rows.tolist()]
    data = np.frombuffer(b"".join(chosen), dtype=np.uint8).reshape(len(chosen), size)
    same = np.ones(len(chosen), dtype=np.bool_)
    for begin, end in form.fixed:
        same &= (data[:, begin:end] == data[0, begin:end]).all(axis=1)
    if not same.all():
        rows, data = rows[same], data[same]
    columns = {name: _column(place, data) for name, place in form.fields.items()}
    return rows, columns


def _column(place: Place | Value, data: NDArray[np.uint8]) -> Column:
    if not isinstance(place, Place):
        return objects([place] * len(data))
    kind = _TYPES[place.letter]
    numbers = np.ascontiguousarray(data[:, place.at : place.at + kind.itemsize]).view(kind)[:, 0]
    if place.letter == "?":
        flags: Column = numbers != 0
        return flags
    if place.letter in "qQ" and len(numbers) and int(np.abs(numbers.astype(np.float64)).max()) >= EXACT:
        return objects(wire_column("", numbers.tolist())[0])
    # Nothing is less than zero of it.
    floats = numbers.astype(np.float64) + 0.0
    if kind.kind == "f" and not (finite := np.isfinite(floats)).all():
        floats[~finite] = np.nan
    return floats


def together(parts: Sequence[tuple[NDArray[np.intp], dict[str, Column]]], n: int) -> dict[str, Column]:
    """The columns of all messages, of which each part has some."""
    if len(parts) == 1 and len(parts[0][0]) == n:
        # In order: the rows of one size are.
        return parts[0][1]
    columns: dict[str, Column] = {}
    for name in dict.fromkeys(name for _, own in parts for name in own):
        having = [(rows, own[name]) for rows, own in parts if name in own]
        kinds = {column.dtype.kind for _, column in having}
        column: NDArray[Any]
        if kinds == {"f"}:
            column = np.full(n, np.nan)
        elif kinds == {"b"} and sum(len(rows) for rows, _ in having) == n:
            column = np.zeros(n, dtype=np.bool_)
        else:
            column = np.full(n, None, dtype=object)
            having = [(rows, objects(values(one))) for rows, one in having]
        for rows, one in having:
            column[rows] = one
        columns[name] = column
    return columns
