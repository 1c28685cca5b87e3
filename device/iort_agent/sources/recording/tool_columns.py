"""The columns of a VESC Tool log, and how their cells are read.

The contract's columns get the contract's names and units, and the others keep their own. The first rows tell
whether numbers have a point or a comma, and which of the other columns hold numbers.
"""

from __future__ import annotations

import math
import re
from typing import Mapping, NamedTuple, Sequence

from iort_contract.catalog.vesc import FAULT_CODES
from iort_contract.limits import Value

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


class BadRowError(ValueError):
    """A row that cannot be used, and the cause that it is counted under."""

    def __init__(self, cause: str, text: str) -> None:
        super().__init__(text)
        self.cause = cause


class _BadCellError(ValueError):
    """A cell that holds no number."""


class _Column(NamedTuple):
    at: int
    label: str
    name: str


class Columns:
    """The columns of a log. ``bad`` are the columns of the last row whose cell holds no number, and why."""

    def __init__(self, labels: Sequence[str], first_rows: Sequence[Sequence[str]]) -> None:
        self.bad: list[tuple[str, str]] = []
        self._time = labels.index(TIME)
        cells = [cell for row in first_rows for cell in row]
        commas, points = (sum(map(bool, map(sign.fullmatch, cells))) for sign in (_WITH_COMMA, _WITH_POINT))
        self._comma = commas > points
        columns = [
            _Column(at, label, _NAMES.get(label, label)) for at, label in enumerate(labels) if label != TIME
        ]
        self.kept = [column for column in columns if self._is_field(column, first_rows)]
        kept = {column.at for column in self.kept}
        self.dropped = [column.label or "(no name)" for column in columns if column.at not in kept]

    def time_of(self, cells: Sequence[str]) -> int:
        """The row's time of day in milliseconds. Raises `BadRowError`."""
        try:
            ms_today = self._number(cells[self._time], TIME)
        except _BadCellError as error:
            raise BadRowError("time", str(error)) from error
        if ms_today is None or not 0 <= ms_today < DAY_MS:
            text = f"{TIME} must be from 0 to {DAY_MS - 1}, got {cells[self._time]!r}"
            raise BadRowError("time", text)
        return int(ms_today)

    def sample(self, cells: Sequence[str]) -> Mapping[str, Value]:
        """The row's sample; a cell that holds no number is null."""
        self.bad = []
        return {column.name: self._value(column, cells[column.at]) for column in self.kept}

    def _is_field(self, column: _Column, rows: Sequence[Sequence[str]]) -> bool:
        """Whether the column is the contract's, or has the name of a field and holds a number or nothing."""
        if column.label in _NAMES:
            return True
        if not _FIELD.fullmatch(column.name) or column.name in _CONTRACT_NAMES:
            return False
        filled = [row[column.at] for row in rows if row[column.at]]
        return not filled or any(_NUMBER.fullmatch(self._plain(cell)) for cell in filled)

    def _value(self, column: _Column, cell: str) -> Value:
        if column.name == "fault_code" and cell[:1].isalpha():
            code = FAULT_CODES.get(cell[len(_FAULT_PREFIX) :] if cell.startswith(_FAULT_PREFIX) else cell)
            if code is None:
                self.bad.append((column.label, f"{column.label} must be a known fault, got {cell[:40]!r}"))
            return code
        try:
            number = self._number(cell, column.label)
        except _BadCellError as error:
            self.bad.append((column.label, str(error)))
            return None
        if column.name in _TEN_THOUSANDTHS and number is not None and math.isfinite(number):
            return round(number * 1e4)
        return number

    def _number(self, cell: str, label: str) -> float | None:
        if not cell:
            return None
        plain = self._plain(cell)
        if not _NUMBER.fullmatch(plain):
            raise _BadCellError(f"{label} must be a number, got {cell[:40]!r}")
        return int(plain) if _WHOLE.fullmatch(plain) else float(plain)

    def _plain(self, cell: str) -> str:
        # In a log with commas, a point is no decimal sign.
        return cell.replace(".", "?").replace(",", ".") if self._comma else cell
