"""Texts of robots, for a terminal or a spreadsheet to show and not to obey."""

from __future__ import annotations

import re

# C0 except tab and new line, DEL and C1, Unicode's line ends and directions, and halves of characters, which
# no output can write.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    """Replace each character that a terminal would obey by its code, as JSON spells it."""
    # JSON's spelling, so that JSON stays JSON.
    return _OBEYED.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def one_line(text: str) -> str:
    """The same, with the codes of line breaks and tabs, for a text among others: it must not begin a line."""
    return visible(text).replace("\n", "\\n").replace("\t", "\\t")
