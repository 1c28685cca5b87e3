"""Words for the operator's terminal, which obeys no character of a robot's text.

An escape sequence in a name or a value could move the cursor, hide a line or write the operator's clipboard
(OSC 52). So every control character except new line and tab is shown as the text of its code. So are the
characters that change the direction of a line.
"""

from __future__ import annotations

import re
import sys

# C0 except tab and new line, DEL and C1, Unicode's line ends and directions, and halves of characters, which
# no output can write.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    """Replace each character that a terminal would obey by its code, as JSON spells it."""
    # JSON's spelling, so that JSON stays JSON.
    return _OBEYED.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def say(text: str) -> None:
    """Print a line on standard error, where it does not get into a pipe."""
    print(visible(f"iort: {text}"), file=sys.stderr, flush=True)
