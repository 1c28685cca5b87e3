"""The kinds of entry: a field, a derived field, a stream and a parameter of an analysis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Callable, Literal


@dataclass(frozen=True)
class Field:
    """A field of a stream.

    ``group`` joins fields of one kind. ``ros`` names the ROS drivers that report it (VESC only).
    ``ros2_unit`` is the ROS 2 driver's unit if it differs. ``label`` is what the page calls the field; empty
    if its name says it.
    """

    name: str
    unit: str
    meaning: str
    group: str = ""
    ros: tuple[int, ...] = ()
    ros2_unit: str | None = None
    label: str = ""


@dataclass(frozen=True)
class Derived:
    """A field that is calculated from others, in the summary, in queries and in notebooks.

    ``formula`` takes fields and vehicle parameters by their names. It uses + - * / alone, so the same code
    calculates with numbers and with numpy's arrays. ``label`` is as in `Field`.
    """

    name: str
    unit: str
    meaning: str
    formula: Callable[..., Any]
    label: str = ""

    @property
    def arguments(self) -> tuple[str, ...]:
        """The names of the formula's arguments, in order."""
        code = self.formula.__code__
        return code.co_varnames[: code.co_argcount]


@dataclass(frozen=True)
class Stream:
    """A stream whose fields are known. ``own`` marks a stream of the agent, which needs no configuration."""

    name: str
    meaning: str
    fields: tuple[Field, ...] = ()
    own: bool = False

    def unit(self, name: str, *, ros2: bool = False) -> str:
        """A field's unit, or the ROS 2 driver's; empty if the field is unknown."""
        found = next((field for field in self.fields if field.name == name), None)
        if found is None:
            return ""
        return (found.ros2_unit if ros2 else None) or found.unit


@dataclass(frozen=True)
class Parameter:
    """A number that is estimated from a drive, with its unit.

    ``worse`` is the direction of a change for the worse; ``kind`` names the finding about such a change,
    empty if a change is no finding. A change counts from ``least`` in the unit and from ``least_share`` of
    the baseline on: less means nothing on a car, and healthy drives differ by a quarter. ``fields`` are
    those of the VESC that it was estimated from. A ``state`` is different after each drive by its nature.
    """

    name: str
    unit: str
    meaning: str
    worse: Literal["up", "down", "either"] = "either"
    kind: str = ""
    fields: tuple[str, ...] = ()
    least: float = 0.0
    least_share: float = 0.2
    state: bool = False

    def least_change(self, baseline: float) -> float:
        """The smallest change from a baseline that means something, in the unit."""
        return max(self.least, self.least_share * abs(baseline))
