"""Reads a VESC Tool log: each row is an answer of the controller, in columns named by VESC Tool.

The header tells the separator, and the first rows tell the decimal sign and the columns that hold numbers. A
cell without a number is null, and a row that does not fit is skipped. Both are counted by cause, and logged
once.
"""

from __future__ import annotations

import datetime as dt
import logging
import math
import re
from collections import Counter
from itertools import chain, count, islice
from pathlib import Path
from typing import Any, Iterator, NamedTuple, Sequence

from iort_contract.catalog.vesc import FAULT_CODES
from iort_contract.limits import MAX_FIELDS, Value
from iort_contract.recordings import Message, RecordingError

TIME = "ms_today"
DAY_MS = 24 * 3600 * 1000
_FIELD = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_WHOLE = re.compile(r"[+-]?\d{1,18}", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)", re.ASCII)
# Numbers with one or the other decimal sign.
_WITH_COMMA = re.compile(r"[+-]?\d*,\d+", re.ASCII)
_WITH_POINT = re.compile(r"[+-]?\d*\.\d+", re.ASCII)
_FAULT_PREFIX = "FAULT_CODE_"

# VESC Tool's name -> the contract's name.
_NAMES = {
    "input_voltage": "voltage_input",
    "temp_mos_max": "temp_fet",
    "temp_mos_1": "ntc_temp_mos1",
    "temp_mos_2": "ntc_temp_mos2",
    "temp_mos_3": "ntc_temp_mos3",
    "temp_motor": "temp_motor",
    "current_motor": "current_motor",
    "current_in": "current_input",
    "d_axis_current": "avg_id",
    "q_axis_current": "avg_iq",
    "erpm": "speed",
    "duty_cycle": "duty_cycle",
    "amp_hours_used": "charge_drawn",
    "amp_hours_charged": "charge_regen",
    "watt_hours_used": "energy_drawn",
    "watt_hours_charged": "energy_regen",
    "tachometer": "displacement",
    "tachometer_abs": "distance_traveled",
    "encoder_position": "pid_pos_now",
    "fault_code": "fault_code",
    "vesc_id": "controller_id",
    "d_axis_voltage": "avg_vd",
    "q_axis_voltage": "avg_vq",
}
_CONTRACT_NAMES = frozenset(_NAMES.values())
# The controller counts these in ten-thousandths; VESC Tool divided them by 10,000.
_TEN_THOUSANDTHS = frozenset({"charge_drawn", "charge_regen", "energy_drawn", "energy_regen"})

# VESC Tool names a log by its local start time. The rows' time of day is UTC since September 2019.
_BEGUN = re.compile(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d")
_BEGUN_FORMAT = "%Y-%m-%d_%H-%M-%S"
# This many rows tell what the columns hold.
_FIRST_ROWS = 100
# VESC Tool writes about 60 columns.
_MAX_COLUMNS, _MAX_LINE = 4096, 256 * 1024

_log = logging.getLogger(__name__)


class _Column(NamedTuple):
    at: int
    label: str
    name: str


class VescLog:
    """A log: calling it opens it again, for each round of the player. The counts are those of all rounds."""

    def __init__(self, path: Path, stream: str, *, original: bool) -> None:
        self._path = path
        self._stream = stream
        self._original = original
        self._comma = False
        self._logged: set[str] = set()
        self._rows_read = self._clock_back = 0
        self._skipped: Counter[str] = Counter()
        self._bad_cells: Counter[str] = Counter()
        self._dropped: list[str] = []

    def report(self) -> dict[str, Any]:
        """The counts: rows read; rows skipped, by cause; cells without a number, by column; rows before which
        the clock went back; and the columns without numbers."""
        return {
            "rows": self._rows_read,
            "skipped": dict(self._skipped),
            "bad_cells": dict(self._bad_cells),
            "clock_back": self._clock_back,
            "columns_left_out": list(self._dropped),
        }

    def __call__(self) -> VescLog:
        """The log, to be entered."""
        return self

    def __enter__(self) -> Iterator[Message]:
        try:
            # Only names of columns may be no UTF-8, and they must not stop the numbers.
            self._file = self._path.open(encoding="utf-8-sig", errors="replace")
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be opened: {error.strerror}") from error
        return self._messages()

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self._skipped:
            self._once("total", f"{sum(self._skipped.values())} rows have been skipped")
        if self._clock_back:
            self._once("back", f"the clock went back before {self._clock_back} rows")

    def _messages(self) -> Iterator[Message]:
        lines = self._lines()
        separator, labels = self._header(next(lines, (0, ""))[1])
        rows = self._rows(lines, separator, len(labels))
        first_rows = list(islice(rows, _FIRST_ROWS))
        columns = self._columns(labels, [cells for _, cells in first_rows])
        time_at, elapsed, base_ns = labels.index(TIME), _Elapsed(), 0
        for number, cells in chain(first_rows, rows):
            ms_today, problem = self._number(cells[time_at])
            if problem or ms_today is None or not 0 <= ms_today < DAY_MS:
                got = cells[time_at][:40]
                self._skip(number, "time", f"{TIME} must be a number from 0 to {DAY_MS - 1}, got {got!r}")
                continue
            at_ms, measured_ms = elapsed.at(int(ms_today))
            if elapsed.rows == 1:
                base_ns = self._begin_ns(int(ms_today))
            self._clock_back += measured_ms < at_ms
            sample: dict[str, Value] = {}
            for column in columns:
                sample[column.name], problem = self._value(column, cells[column.at])
                if problem:
                    self._bad_cells[column.label] += 1
                    got = f"got {cells[column.at][:40]!r}: null"
                    self._once(
                        f"cell {column.label}", f"row {number}: {column.label} must be {problem}, {got}"
                    )
            yield Message(self._stream, at_ms * 1_000_000, base_ns + measured_ms * 1_000_000, sample)
        if not elapsed.rows:
            raise RecordingError(f"{self._path}: it has no row that can be read")

    def _columns(self, labels: Sequence[str], rows: Sequence[Sequence[str]]) -> list[_Column]:
        """The columns that are fields: the contract's, and those that hold a number or nothing."""
        cells = [cell for row in rows for cell in row]
        commas, points = (sum(map(bool, map(sign.fullmatch, cells))) for sign in (_WITH_COMMA, _WITH_POINT))
        self._comma = commas > points
        columns, self._dropped = [], []
        for at, label in enumerate(labels):
            if label in _NAMES or (label != TIME and self._is_field(label, [row[at] for row in rows])):
                columns.append(_Column(at, label, _NAMES.get(label, label)))
            elif label != TIME:
                self._dropped.append(label or "(no name)")
        if len(columns) > MAX_FIELDS:
            raise RecordingError(
                f"{self._path}: {len(columns)} of its columns hold numbers, and a sample has at most "
                f"{MAX_FIELDS} fields: take columns out of the file"
            )
        if self._dropped:
            self._once("dropped", f"columns that hold no numbers: {', '.join(self._dropped)}")
        return columns

    def _is_field(self, name: str, cells: Sequence[str]) -> bool:
        if not _FIELD.fullmatch(name) or name in _CONTRACT_NAMES:
            return False
        filled = [cell for cell in cells if cell]
        return not filled or any(_NUMBER.fullmatch(self._plain(cell)) for cell in filled)

    def _value(self, column: _Column, cell: str) -> tuple[Value, str]:
        """A cell's value, and what it must be if it has none."""
        if column.name == "fault_code" and cell[:1].isalpha():
            code = FAULT_CODES.get(cell[len(_FAULT_PREFIX) :] if cell.startswith(_FAULT_PREFIX) else cell)
            return code, "" if code is not None else "a known fault"
        number, problem = self._number(cell)
        if column.name in _TEN_THOUSANDTHS and number is not None and math.isfinite(number):
            number = round(number * 1e4)
        return number, problem

    def _number(self, cell: str) -> tuple[float | None, str]:
        """As `_value`, of a cell that is a number or empty."""
        plain = self._plain(cell)
        if cell and not _NUMBER.fullmatch(plain):
            return None, "a number"
        if not cell:
            return None, ""
        return int(plain) if _WHOLE.fullmatch(plain) else float(plain), ""

    def _plain(self, cell: str) -> str:
        # In a log with commas, a point is no decimal sign.
        return cell.replace(".", "?").replace(",", ".") if self._comma else cell

    def _rows(
        self, lines: Iterator[tuple[int, str]], separator: str, wanted: int
    ) -> Iterator[tuple[int, list[str]]]:
        for number, line in lines:
            self._rows_read += 1
            cells = line.split(separator)
            # VESC Tool ends a row with a separator.
            if len(cells) == wanted + 1 and not cells[-1].strip():
                cells.pop()
            if len(cells) == wanted:
                yield number, [cell.strip() for cell in cells]
            else:
                self._skip(number, "columns", f"{len(cells)} columns, and the first line names {wanted}")

    def _skip(self, number: int, cause: str, why: str) -> None:
        self._skipped[cause] += 1
        self._once("skipped", f"row {number} is skipped: {why}")

    def _lines(self) -> Iterator[tuple[int, str]]:
        """The lines that are not empty, numbered as in an editor."""
        try:
            for number in count(1):
                line = more = self._file.readline(_MAX_LINE)
                if not line:
                    return
                # A line that is longer does not fit the first one, so its beginning is enough.
                while len(more) == _MAX_LINE and not more.endswith("\n"):
                    more = self._file.readline(_MAX_LINE)
                if line.strip():
                    yield number, line.strip()
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be read: {error.strerror}") from error

    def _header(self, line: str) -> tuple[str, list[str]]:
        separator = next((sign for sign in (";", "\t", ",") if sign in line), ";")
        labels = [label.strip() for label in line.split(separator)]
        if not labels[-1]:
            labels.pop()
        if len(labels) > _MAX_COLUMNS:
            raise RecordingError(
                f"{self._path}: it must have at most {_MAX_COLUMNS:,} columns, got {len(labels):,} or more"
            )
        if TIME not in labels:
            raise RecordingError(
                f"{self._path}: is no VESC Tool log: its first line has no column {TIME}: {line[:80]!r}"
            )
        twice = sorted(label for label, count in Counter(labels).items() if count > 1)
        if twice:
            raise RecordingError(f"{self._path}: the columns {', '.join(twice)} are there twice")
        return separator, labels

    def _begin_ns(self, ms_today: int) -> int:
        """The time of the first row, in nanoseconds since the epoch; rows hold only a time of day."""
        if not self._original:
            return 0
        begun = _BEGUN.search(self._path.name)
        try:
            named = dt.datetime.strptime(begun.group(), _BEGUN_FORMAT) if begun else None  # noqa: DTZ007 - local
        except ValueError:
            named = None
        if named is None:
            raise RecordingError(
                f"{self._path}: `stamps: original` needs the day, and rows hold only the time of day: name "
                "the file by its start, as VESC Tool does (2024-06-12_00-34-31.csv)"
            )
        # The name is local time in this machine's zone; the row is UTC without a date. The date that comes
        # nearest to the name is taken, so a zone that is wrong by hours does no harm.
        named_ms = round(named.timestamp() * 1000)
        days = round((named_ms - ms_today) / DAY_MS)
        return (days * DAY_MS + ms_today) * 1_000_000

    def _once(self, key: str, text: str) -> None:
        if key not in self._logged:
            self._logged.add(key)
            _log.warning("%s: %s", self._path, text)


class _Elapsed:
    """Milliseconds since the first row; the time of day begins again at midnight."""

    def __init__(self) -> None:
        self.rows = 0
        self._first = self._last = 0
        self._days = 0

    def at(self, ms_today: int) -> tuple[int, int]:
        """The time that has passed, and the time by the log's clock, which is less if the clock was set
        back."""
        if not self.rows:
            self._first = self._last = ms_today
        elif self._last - ms_today > DAY_MS // 2:
            self._days += 1
            self._last = ms_today
        # After a clock was set back a little, no time passes until it has caught up.
        self._last = max(self._last, ms_today)
        self.rows += 1
        begun = self._days * DAY_MS - self._first
        return begun + self._last, begun + ms_today
