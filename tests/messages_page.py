"""Reads docs/reference/messages.md: its examples by name, and its tables."""

from __future__ import annotations

import json
import re
from typing import Any, NamedTuple

from scripts.docs_parts import ROOT

PAGE = (ROOT / "docs/reference/messages.md").read_text()
_EXAMPLE = re.compile(r"<!-- example: (\w+) -->\n```json\n(.*?)```\n(.*?)(?=<!-- example|\Z)", re.DOTALL)
_TABLE = re.compile(r"^\|.*\|\n\|[-|:]+\|\n((?:\|.*\|\n)+)", re.MULTILINE)

# The messages of the examples.
EXAMPLES: dict[str, dict[str, Any]] = {name: json.loads(text) for name, text, _ in _EXAMPLE.findall(PAGE)}


def rows(text: str) -> list[list[str]]:
    """Return the cells of the first table in a text, row by row."""
    found = _TABLE.search(text)
    assert found is not None, text[:200]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in found[1].splitlines()]


def section(title: str) -> str:
    """Return the text below a heading, up to the next heading of its rank or above."""
    return re.split(rf"^#{{1,{title.count('#')}}} ", PAGE.split(f"\n{title}\n")[1], flags=re.MULTILINE)[0]


class Key(NamedTuple):
    """A table's row on a message's key."""

    what: str
    needed: bool


def keys_after(name: str) -> dict[str, Key]:
    """Return the keys in the table behind an example, by dotted path."""
    behind = next(rest for one, _, rest in _EXAMPLE.findall(PAGE) if one == name)
    return {key: Key(row[2], row[3] == "yes") for row in rows(behind) for key in named(row[0])}


def named(cell: str) -> list[str]:
    """Return the names in code's type within a cell."""
    return re.findall(r"`([^`]+)`", cell)
