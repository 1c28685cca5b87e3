"""Reads a log of VESC Tool: one row an answer of the controller, in columns named by VESC Tool.

The columns that the contract knows get its names and units, the others keep their own. What a log is
not sure to be is looked at in its first rows, not assumed: the separator by the header, the decimal point
or comma by the numbers, and which other columns hold numbers at all. A cell that is no number is null; a
row that does not fit is skipped. Both are counted by cause, and told once.
"""

from __future__ import annotations

import datetime as dt
import logging
import math
import re
from collections import Counter
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Callable, Iterator, Mapping, NamedTuple, Sequence

from iort_agent.errors import SourceError
from iort_agent.sources.recording.player import ORIGINAL, Message
from iort_contract.catalog.vesc import FAULT_CODES
from iort_contract.limits import MAX_FIELDS, Value

if TYPE_CHECKING:
    from typing_extensions import Self

_log = logging.getLogger(__name__)

TIME = "ms_today"
GNSS_TIME = "gnss_posTime"
_DAY_MS = 24 * 3600 * 1000
# VESC Tool names its logs by when they were begun, in local time; the rows' time of day is UTC since 2019-09.
_BEGUN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")
_BEGUN_FORMAT = "%Y-%m-%d_%H-%M-%S"
_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII)
# A number that only the one or the other decimal sign makes one.
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+", re.ASCII)
_WITH_POINT = re.compile(r"[+-]?\d*\.\d+", re.ASCII)
_FAULT_PREFIX = "FAULT_CODE_"

# So many rows say what a log is.
_FIRST_ROWS = 100
# A fix is older than its row by up to three seconds, and a phone's clock may be off by as much again.
_GNSS_APART_MS = 60_000

Read = Callable[[float], Value]


def _as_is(value: float) -> Value:
    return value


def _ten_thousandths(value: float) -> Value:
    """Ah and Wh as the controller counts them; VESC Tool divided by 10,000."""
    return round(value * 1e4) if math.isfinite(value) else value


# VESC Tool's name -> the contract's, and what becomes of the number.
_COLUMNS: dict[str, tuple[str, Read]] = {
    "input_voltage": ("voltage_input", _as_is),
    "temp_mos_max": ("temp_fet", _as_is),
    "temp_mos_1": ("ntc_temp_mos1", _as_is),
    "temp_mos_2": ("ntc_temp_mos2", _as_is),
    "temp_mos_3": ("ntc_temp_mos3", _as_is),
    "temp_motor": ("temp_motor", _as_is),
    "current_motor": ("current_motor", _as_is),
    "current_in": ("current_input", _as_is),
    "d_axis_current": ("avg_id", _as_is),
    "q_axis_current": ("avg_iq", _as_is),
    "erpm": ("speed", _as_is),
    "duty_cycle": ("duty_cycle", _as_is),
    "amp_hours_used": ("charge_drawn", _ten_thousandths),
    "amp_hours_charged": ("charge_regen", _ten_thousandths),
    "watt_hours_used": ("energy_drawn", _ten_thousandths),
    "watt_hours_charged": ("energy_regen", _ten_thousandths),
    "tachometer": ("displacement", _as_is),
    "tachometer_abs": ("distance_traveled", _as_is),
    "encoder_position": ("pid_pos_now", _as_is),
    "fault_code": ("fault_code", _as_is),
    "vesc_id": ("controller_id", _as_is),
    "d_axis_voltage": ("avg_vd", _as_is),
    "q_axis_voltage": ("avg_vq", _as_is),
}
_CONTRACTS = frozenset(name for name, _ in _COLUMNS.values())


class _Column(NamedTuple):
    at: int
    label: str
    name: str
    read: Read
    known: bool


class _BadRowError(ValueError):
    """The row cannot be taken: why, for people, and the cause that it is counted under."""

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(text)
        self.cause = cause


class _BadCellError(ValueError):
    """A cell is no number."""


class VescLog:
    """A log, opened anew for each round of the player; what is counted is of all rounds."""

    def __init__(self, path: Path, stream: str, stamps: str) -> None:
        self._path = path
        self._stream = stream
        self._stamps = stamps
        self._said: set[str] = set()
        self._rows_read = self._clock_back = 0
        self._skipped: Counter[str] = Counter()
        self._bad_cells: Counter[str] = Counter()
        self._dropped: list[str] = []
        self._gnss_ahead_ms: int | None = None

    def report(self) -> dict[str, Any]:
        """Rows read; rows skipped by cause and cells that were null for being no number by column; rows
        whose clock had gone back; columns without numbers; and how far ahead of the log's clock the first
        position's time is."""
        return {
            "rows": self._rows_read,
            "skipped": dict(self._skipped),
            "bad_cells": dict(self._bad_cells),
            "clock_back": self._clock_back,
            "columns_left_out": list(self._dropped),
            "gnss_ahead_ms": self._gnss_ahead_ms,
        }

    def open(self) -> Self:
        """The log, to be entered."""
        return self

    def __enter__(self) -> Iterator[Message]:
        try:
            # What is no UTF-8 stands in names of columns, if anywhere, and must not stop the numbers.
            self._file = self._path.open(encoding="utf-8-sig", errors="replace")
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be opened: {error.strerror}") from error
        return self._messages()

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self._skipped:
            self._once("total", f"{sum(self._skipped.values())} rows have been skipped")
        if self._clock_back:
            self._once("back", f"the clock went back before {self._clock_back} rows")

    def _messages(self) -> Iterator[Message]:
        lines = self._lines()
        _, header = next(lines, (0, ""))
        separator, names = self._header(header)
        rows = self._cells(lines, separator, len(names))
        first_rows = list(islice(rows, _FIRST_ROWS))
        table = _Table(names, [cells for _, cells in first_rows])
        self._dropped = table.dropped
        if table.width > MAX_FIELDS:
            raise SourceError(
                f"{self._path}: {table.width} of its columns hold numbers, and a sample has at most "
                f"{MAX_FIELDS} fields: take columns out of the file"
            )
        if table.dropped:
            self._once("dropped", f"columns that hold no numbers: {', '.join(table.dropped)}")
        elapsed = _Elapsed()
        base_ns = 0
        for number, cells in chain(first_rows, rows):
            try:
                ms_today = table.time_of(cells)
            except _BadRowError as error:
                self._skip(number, error)
                continue
            at_ms, measured_ms = elapsed.at(ms_today)
            if elapsed.rows == 1:
                base_ns = self._begin_ns(ms_today)
            self._clock_back += measured_ms < at_ms
            values = table.read(cells)
            for column, why in table.bad:
                self._bad_cells[column] += 1
                self._once(f"cell {column}", f"row {number}: {why}: null")
            self._compare(ms_today, values.get(GNSS_TIME))
            yield Message(self._stream, at_ms * 1_000_000, base_ns + measured_ms * 1_000_000, values)
        if not elapsed.rows:
            raise SourceError(f"{self._path}: there is no row in it that can be read")

    def _cells(
        self, lines: Iterator[tuple[int, str]], separator: str, wanted: int
    ) -> Iterator[tuple[int, list[str]]]:
        for number, line in lines:
            self._rows_read += 1
            try:
                yield number, _cells(line, separator, wanted)
            except _BadRowError as error:
                self._skip(number, error)

    def _skip(self, number: int, error: _BadRowError) -> None:
        self._skipped[error.cause] += 1
        self._once("skipped", f"row {number} is skipped: {error}")

    def _compare(self, ms_today: int, fix_ms: Value) -> None:
        """Hold the first position's time, UTC whatever the device's clock says, against its row's."""
        if self._gnss_ahead_ms is not None or not isinstance(fix_ms, (int, float)) or not fix_ms > 0:
            return
        # Over midnight, too: between minus and plus half a day.
        ahead_ms = (round(fix_ms) - ms_today + _DAY_MS // 2) % _DAY_MS - _DAY_MS // 2
        self._gnss_ahead_ms = ahead_ms
        if abs(ahead_ms) > _GNSS_APART_MS:
            self._once(
                "gnss",
                f"the clock of the log is {-ahead_ms / 1000:+.0f} s off, by the first position's time "
                f"({GNSS_TIME}); VESC Tool of before September 2019 wrote local time",
            )

    def _lines(self) -> Iterator[tuple[int, str]]:
        """The lines that are not empty, numbered as an editor does."""
        try:
            for number, line in enumerate(self._file, 1):
                if line.strip():
                    yield number, line.strip()
        except OSError as error:
            raise SourceError(f"{self._path}: cannot be read: {error.strerror}") from error

    def _header(self, line: str) -> tuple[str, list[str]]:
        separator = next((s for s in (";", "\t", ",") if s in line), ";")
        names = [name.strip() for name in line.split(separator)]
        if not names[-1]:
            names.pop()
        if TIME not in names:
            raise SourceError(
                f"{self._path}: is no log of VESC Tool: its first line has no column {TIME}: {line[:80]!r}"
            )
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SourceError(f"{self._path}: the columns {', '.join(twice)} are there twice")
        return separator, names

    def _begin_ns(self, ms_today: int) -> int:
        """When the first row was measured, in nanoseconds since the epoch; rows only hold a time of day."""
        if self._stamps != ORIGINAL:
            return 0
        begun = _BEGUN.search(self._path.name)
        try:
            named = dt.datetime.strptime(begun.group(), _BEGUN_FORMAT) if begun else None  # noqa: DTZ007 - local
        except ValueError:
            named = None
        if named is None:
            raise SourceError(
                f"{self._path}: `stamps: original` needs the day, and rows hold only the time of day: name "
                "the file by when it was begun, as VESC Tool does (2024-06-12_00-34-31.csv)"
            )
        # The name is local time, by this machine's zone, and the row UTC without a date: of the dates around
        # the name's, the one that comes nearest to it. So a zone that is wrong by hours does no harm.
        named_ms = round(named.timestamp() * 1000)
        days = round((named_ms - ms_today) / _DAY_MS)
        return (days * _DAY_MS + ms_today) * 1_000_000

    def _once(self, key: str, text: str) -> None:
        if key not in self._said:
            self._said.add(key)
            _log.warning("%s: %s", self._path, text)


def _cells(line: str, separator: str, wanted: int) -> list[str]:
    cells = line.split(separator)
    # VESC Tool ends a row with a separator.
    if len(cells) == wanted + 1 and not cells[-1].strip():
        cells.pop()
    if len(cells) != wanted:
        raise _BadRowError("columns", f"{len(cells)} columns, and the first line names {wanted}")
    return [cell.strip() for cell in cells]


class _Elapsed:
    """Milliseconds since the first row; the time of day starts again at midnight."""

    def __init__(self) -> None:
        self.rows = 0
        self._first = self._last = 0
        self._days = 0

    def at(self, ms_today: int) -> tuple[int, int]:
        """As it passed, and as the log's clock said it; the latter is less where that clock was set back."""
        if not self.rows:
            self._first = self._last = ms_today
        elif self._last - ms_today > _DAY_MS // 2:
            self._days += 1
            self._last = ms_today
        # A clock set back a little: no time passes until it has caught up.
        self._last = max(self._last, ms_today)
        self.rows += 1
        begun = self._days * _DAY_MS - self._first
        return begun + self._last, begun + ms_today


class _Table:
    """The columns, and how their cells are read, as far as the first rows tell. ``bad`` are the columns of
    the row last read whose cell is no number, and why."""

    def __init__(self, names: Sequence[str], first_rows: Sequence[Sequence[str]]) -> None:
        self.bad: list[tuple[str, str]] = []
        self._time = names.index(TIME)
        cells = [cell for row in first_rows for cell in row]
        commas = sum(map(bool, map(_WITH_COMMA.fullmatch, cells)))
        points = sum(map(bool, map(_WITH_POINT.fullmatch, cells)))
        self._comma = commas > points
        columns = [
            _Column(i, name, *_COLUMNS.get(name, (name, _as_is)), known=name in _COLUMNS)
            for i, name in enumerate(names)
            if name != TIME
        ]
        self._columns = [column for column in columns if self._fits(column, first_rows)]
        self.dropped = [column.label or "(no name)" for column in columns if column not in self._columns]

    @property
    def width(self) -> int:
        """How many columns are fields."""
        return len(self._columns)

    def time_of(self, cells: Sequence[str]) -> int:
        """The row's time of day in milliseconds. Raises `_BadRowError`."""
        try:
            ms_today = self._number(cells[self._time], TIME)
        except _BadCellError as error:
            raise _BadRowError("time", str(error)) from error
        if ms_today is None or not 0 <= ms_today < _DAY_MS:
            raise _BadRowError(
                "time", f"{TIME} is {cells[self._time]!r}, and must be from 0 to {_DAY_MS - 1}"
            )
        return int(ms_today)

    def read(self, cells: Sequence[str]) -> Mapping[str, Value]:
        """The sample."""
        self.bad = []
        return {column.name: self._value(column, cells[column.at]) for column in self._columns}

    def _fits(self, column: _Column, rows: Sequence[Sequence[str]]) -> bool:
        """Whether a column can be a field: another than the contract's has a name that can be one, and a
        number in any of the rows, or no cell that is none."""
        if column.known:
            return True
        if not _FIELD.fullmatch(column.name) or column.name in _CONTRACTS:
            return False
        filled = [row[column.at] for row in rows if row[column.at]]
        return not filled or any(_NUMBER.fullmatch(self._plain(cell)) for cell in filled)

    def _value(self, column: _Column, cell: str) -> Value:
        if column.name == "fault_code" and cell[:1].isalpha():
            code = FAULT_CODES.get(cell[len(_FAULT_PREFIX) :] if cell.startswith(_FAULT_PREFIX) else cell)
            if code is None:
                self.bad.append((column.label, f"no such fault is known as {cell[:40]!r}"))
            return code
        try:
            number = self._number(cell, column.label)
        except _BadCellError as error:
            self.bad.append((column.label, str(error)))
            return None
        return None if number is None else column.read(number)

    def _number(self, cell: str, name: str) -> float | None:
        if not cell:
            return None
        plain = self._plain(cell)
        if not _NUMBER.fullmatch(plain):
            raise _BadCellError(f"{name} is {cell[:40]!r}, which is no number")
        return int(plain) if _WHOLE.fullmatch(plain) else float(plain)

    def _plain(self, cell: str) -> str:
        # In a log with commas, a point separates nothing that we know of.
        return cell.replace(".", "?").replace(",", ".") if self._comma else cell
