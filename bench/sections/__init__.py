"""The sections of the bench: each module declares in `SECTION` what it measures, and its options.

`make bench` measures the tables of the thesis, `make bench ONLY=agent` any other instrument too.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from bench.report import BENCH, Report, Section

# What `make bench` measures, in the order of the report.
SECTIONS = (
    *(
        "round_trips",
        "dashboard",
        "viewing",
        "utilisation",
        "query",
        "command",
        "abilities",
        "cost",
        "outage",
    ),
    *("scale", "mixed", "fairness"),
)
# Each is measured by its name alone.
ALL = (
    *SECTIONS,
    *("agent", "fleet", "drive", "stop", "page", "look", "cold", "worst"),
    *("analysis", "analysis-cloud", "kept", "soak", "guard"),
)


def yes(text: str) -> bool:
    """A make variable that is set."""
    return text.lower() not in {"", "0", "no", "false"}


def numbers(text: str) -> list[int]:
    """Whole numbers with spaces between."""
    return [int(one) for one in text.split()]


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
    case; its target is None unless a section of the run wants a ``cloud``. ``prepare`` runs before all."""

    what: str
    measure: Callable[..., Section | Sequence[Section]]
    options: Sequence[Option] = ()
    report: Report = BENCH
    cloud: bool = True
    prepare: Callable[[], None] = lambda: None


def load(key: str) -> Declared:
    """The declaration of a section."""
    module = key if key != "scale" else "fleet"
    found: Declared = getattr(
        import_module(f"bench.sections.{module.replace('-', '_')}"), "SCALE" if key == "scale" else "SECTION"
    )
    return found


def values(declared: Mapping[str, Declared], given: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The options' values by section, from ``NAME=VALUE``. Raises `ValueError` for what none of them has."""
    texts = dict(text.partition("=")[::2] for text in given)
    known = {option.name for each in declared.values() for option in each.options}
    if unknown := sorted(texts.keys() - known):
        has = ", ".join(sorted(known)) or "no options"
        raise ValueError(f"{', '.join(unknown)}: {', '.join(declared)} has {has}")
    found: dict[str, dict[str, Any]] = {key: {} for key in declared}
    for key, each in declared.items():
        for option in each.options:
            try:
                value = option.read(texts[option.name]) if option.name in texts else option.default
            except (ValueError, argparse.ArgumentTypeError) as error:
                raise ValueError(f"{option.name}={texts[option.name]}: {error}") from error
            found[key][option.name.lower()] = value
    return found


def manual() -> str:
    """Every section with its options, for `--help`."""
    lines = ["sections, and their options:"]
    for key in ALL:
        each = load(key)
        lines.append(f"  {key:15}{each.what}")
        lines += [f"  {'':17}{one.name}={one.default}: {one.what}" for one in each.options]
    return "\n".join(lines)
