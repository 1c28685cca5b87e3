"""What `iort` prints, whose texts may come from robots: a terminal obeys no character of them.

An escape sequence in a name or a value could move the cursor, hide a line or write the operator's clipboard
(OSC 52). So every control character is shown as the text of its code, wherever the output goes, but for the
new line and the tab. The characters that turn a line's direction are shown so too, and no text is
rich's markup.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from rich import console
from rich.segment import Segment
from rich.text import Text

# C0 but for tab and new line, DEL and C1, Unicode's line ends and directions, and halves of characters, which
# no output can write.
_OBEYED = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    """The text with what a terminal would obey as the code that JSON writes for it."""
    return _OBEYED.sub(_code, text)


def _code(match: re.Match[str]) -> str:
    # JSON's spelling, so that JSON stays JSON.
    return f"\\u{ord(match[0]):04x}"


class Console(console.Console):
    """rich's console; what it lays out has no control characters but those that rich adds itself, and a style
    is given as `style` or a `Text`, not within a string."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **given})

    def render_str(self, text: str, **given: Any) -> Text:
        """As rich's own; before the layout, which counts characters."""
        return super().render_str(visible(text), **given)

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As rich's own; also of what is no string, such as a `Text`."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text))
