"""Reads a log of VESC Tool: one row an answer of the controller, in columns named by VESC Tool.

The columns that the contract knows get its names and units, the others keep their own. What a log is
not sure to be is looked at, not assumed: the separator by the header, the decimal point or comma by the
first number that has one. A row that does not fit is skipped, counted and its number told once.
"""

from __future__ import annotations

import datetime as dt
import logging
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Callable, Iterator, Mapping, NamedTuple, Sequence

from contract import FAULT_CODES, Value
from device.errors import SourceError
from device.sources.player import ORIGINAL, Message
from device.sources.vesc_protocol import without_sensor

if TYPE_CHECKING:
    from typing_extensions import Self

_log = logging.getLogger(__name__)

TIME = "ms_today"
_DAY_MS = 24 * 3600 * 1000
# VESC Tool names its logs by when they were begun, in the local time that ms_today counts.
_BEGUN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")
_BEGUN_FORMAT = "%Y-%m-%d_%H-%M-%S"
_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII)
_FAULT_PREFIX = "FAULT_CODE_"

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
    "temp_motor": ("temp_motor", without_sensor),
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


class _Column(NamedTuple):
    at: int
    label: str
    name: str
    read: Read
    known: bool


class _BadRowError(ValueError):
    """The row cannot be taken; the text says why."""


class VescLog:
    """A log, opened anew for each round of the player; ``skipped`` counts the rows of all rounds."""

    def __init__(self, path: Path, stream: str, stamps: str) -> None:
        self.skipped = 0
        self._path = path
        self._stream = stream
        self._stamps = stamps
        self._said: set[str] = set()

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
        if self.skipped:
            self._once("total", f"{self.skipped} rows have been skipped")

    def _messages(self) -> Iterator[Message]:
        rows = self._rows()
        _, header = next(rows, (0, ""))
        separator, names = self._header(header)
        table = _Table(names)
        elapsed = _Elapsed()
        base_ns = 0
        for number, line in rows:
            try:
                cells = _cells(line, separator, len(names))
                ms_today, values = table.read(cells)
                at_ms = elapsed.at(ms_today)
            except _BadRowError as error:
                self.skipped += 1
                self._once("skipped", f"row {number} is skipped: {error}")
                continue
            if elapsed.rows == 1:
                base_ns = self._begin_ns(ms_today)
                if table.dropped:
                    self._once("dropped", f"columns that hold no numbers: {', '.join(table.dropped)}")
            for what in table.odd:
                self._once(what, f"row {number}: {what}")
            yield Message(self._stream, at_ms * 1_000_000, base_ns + at_ms * 1_000_000, values)
        if not elapsed.rows:
            raise SourceError(f"{self._path}: there is no row in it that can be read")

    def _rows(self) -> Iterator[tuple[int, str]]:
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
        midnight = named.replace(hour=0, minute=0, second=0)
        # The first row may come after the midnight that the file was opened before.
        named_ms = (named - midnight) // dt.timedelta(milliseconds=1)
        days = 1 if named_ms - ms_today > _DAY_MS // 2 else 0
        first = midnight + dt.timedelta(days=days, milliseconds=ms_today)
        return round(first.timestamp() * 1000) * 1_000_000

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
        raise _BadRowError(f"{len(cells)} columns, and the first line names {wanted}")
    return [cell.strip() for cell in cells]


class _Elapsed:
    """Milliseconds since the first row; the time of day starts again at midnight."""

    def __init__(self) -> None:
        self.rows = 0
        self._first = self._last = 0
        self._days = 0

    def at(self, ms_today: int) -> int:
        if not self.rows:
            self._first = self._last = ms_today
        elif self._last - ms_today > _DAY_MS // 2:
            self._days += 1
            self._last = ms_today
        # A clock set back a little: no time passes until it has caught up.
        self._last = max(self._last, ms_today)
        self.rows += 1
        return self._days * _DAY_MS + self._last - self._first


class _Table:
    """The columns, and how their cells are read. Which ones hold numbers, the first good row tells."""

    def __init__(self, names: Sequence[str]) -> None:
        self.dropped: list[str] = []
        self.odd: list[str] = []
        self._time = names.index(TIME)
        self._decimal = ""
        self._columns = [
            _Column(i, name, *_COLUMNS.get(name, (name, _as_is)), known=name in _COLUMNS)
            for i, name in enumerate(names)
            if name != TIME
        ]
        self._settled = False

    def read(self, cells: Sequence[str]) -> tuple[int, Mapping[str, Value]]:
        """The time of day in milliseconds, and the sample. Raises `_BadRowError`."""
        self.odd = []
        decimal = self._decimal_of(cells)
        ms_today = self._number(cells[self._time], decimal, TIME)
        if ms_today is None or not 0 <= ms_today < _DAY_MS:
            raise _BadRowError(f"{TIME} is {cells[self._time]!r}, and a day has {_DAY_MS} ms")
        columns, dropped = (self._columns, self.dropped) if self._settled else self._settle(cells, decimal)
        values = {column.name: self._value(column, cells[column.at], decimal) for column in columns}
        # Only a row that is good to its end says anything about the others.
        self._settled, self._columns, self.dropped, self._decimal = True, columns, dropped, decimal
        return int(ms_today), values

    def _settle(self, cells: Sequence[str], decimal: str) -> tuple[list[_Column], list[str]]:
        taken = {name for name, _ in _COLUMNS.values()}
        kept: list[_Column] = []
        dropped: list[_Column] = []
        for column in self._columns:
            fits = column.known or (_FIELD.fullmatch(column.name) and column.name not in taken)
            try:
                if not column.known:
                    self._number(cells[column.at], decimal, column.label)
            except _BadRowError:
                fits = False
            (kept if fits else dropped).append(column)
        return kept, [column.name or "(no name)" for column in dropped]

    def _value(self, column: _Column, cell: str, decimal: str) -> Value:
        if column.name == "fault_code" and cell[:1].isalpha():
            code = FAULT_CODES.get(cell[len(_FAULT_PREFIX) :] if cell.startswith(_FAULT_PREFIX) else cell)
            if code is None:
                self.odd.append(f"no such fault is known as {cell!r}")
            return code
        number = self._number(cell, decimal, column.label)
        return None if number is None else column.read(number)

    def _decimal_of(self, cells: Sequence[str]) -> str:
        """The decimal sign of the log, once a cell has one."""
        if self._decimal:
            return self._decimal
        signs = {sign for cell in cells for sign in ".," if sign in cell}
        if len(signs) > 1:
            raise _BadRowError("both point and comma stand in numbers")
        return signs.pop() if signs else ""

    @staticmethod
    def _number(cell: str, decimal: str, name: str) -> float | None:
        if not cell:
            return None
        # In a log with commas, a point separates nothing that we know of.
        plain = cell.replace(".", "?").replace(",", ".") if decimal == "," else cell
        if not _NUMBER.fullmatch(plain):
            raise _BadRowError(f"{name} is {cell[:40]!r}, which is no number")
        return int(plain) if _WHOLE.fullmatch(plain) else float(plain)
