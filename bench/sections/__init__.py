"""The sections of the bench: each module declares in `SECTION` what it measures, and its options.

`make bench` measures the tables of the thesis, `make bench ONLY=agent` any other instrument too.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from keyword import iskeyword
from typing import Any

from bench.report import BENCH, Report, Section

# What `make bench` measures, in the order of the report.
SECTIONS = (
    *("round_trips", "dashboard", "viewing", "utilisation", "query", "command", "cost", "outage"),
    *("fleet", "mixed", "fairness"),
)
# Each is measured by its name alone.
ALL = (
    *SECTIONS,
    "agent",
    "drive",
    "stop",
    "page",
    "past",
    "cold",
    "analysis",
    "kept",
    "guard",
    "ros2",
    "recorder",
    "import",
    "bridge",
    "video",
)


def numbers(text: str) -> list[int]:
    """Whole numbers with spaces between."""
    return [int(number) for number in text.split()]


@dataclass(frozen=True)
class Option:
    """A make variable of a section, in its own words."""

    name: str
    read: Callable[[str], Any]
    default: Any
    what: str


@dataclass(frozen=True)
class Declared:
    """``measure`` gets the target, a function that says the step, and the options by their names in lower
    case; its target is None unless a section of the run wants a ``cloud``.
    ``dollars`` is what the section costs on AWS at list prices, generously; None if it does not run there.
    """

    what: str
    measure: Callable[..., Section | Sequence[Section]]
    options: Sequence[Option] = ()
    report: Report = BENCH
    cloud: bool = True
    dollars: float | None = None


def load(key: str) -> Declared:
    """The declaration of a section."""
    # A module cannot have the name of a keyword.
    name = f"{key}_" if iskeyword(key) else key
    declared: Declared = import_module(f"bench.sections.{name}").SECTION
    return declared


def values(declared: Mapping[str, Declared], given: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The options' values by section, from ``NAME=VALUE``. Raises `ValueError` for what none of them has."""
    texts = dict(text.partition("=")[::2] for text in given)
    known = {option.name for each in declared.values() for option in each.options}
    if unknown := sorted(texts.keys() - known):
        has = ", ".join(sorted(known)) or "no options"
        raise ValueError(f"{', '.join(unknown)}: {', '.join(declared)} has {has}")
    result: dict[str, dict[str, Any]] = {key: {} for key in declared}
    for key, each in declared.items():
        for option in each.options:
            try:
                value = option.read(texts[option.name]) if option.name in texts else option.default
            except (ValueError, argparse.ArgumentTypeError) as error:
                raise ValueError(f"{option.name}={texts[option.name]}: {error}") from error
            result[key][option.name.lower()] = value
    return result


def manual() -> str:
    """Every section with its options, for `--help`."""
    lines = ["sections, and their options:"]
    for key in ALL:
        each = load(key)
        lines.append(f"  {key:15}{each.what}")
        lines += [f"  {'':17}{option.name}={option.default}: {option.what}" for option in each.options]
    return "\n".join(lines)
