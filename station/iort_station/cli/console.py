"""Prints texts that may come from robots: a terminal obeys no character of them.

An escape sequence in a name or a value could move the cursor, hide a line or write the operator's clipboard
(OSC 52). So every control character except new line and tab is shown as the text of its code. Characters
that change the direction of a line are shown so too, and no text is rich's markup.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from decimal import Decimal
from typing import Any

from rich import console
from rich.segment import Segment
from rich.text import Text

from iort_station.texts import one_line, visible


class Console(console.Console):
    """rich's console without control characters in the content. A style is an argument or a `Text`."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **given})

    def print(self, *objects: Any, lines: bool = False, **given: Any) -> None:
        """As rich does. A text is one line unless it has ``lines`` of our own: a robot's must begin none."""
        shown = [one_line(one) if isinstance(one, str) and not lines else one for one in objects]
        super().print(*shown, **given)

    def render_str(self, text: str, **given: Any) -> Text:
        """As rich does; before the layout, which counts characters."""
        return super().render_str(visible(text), **given)

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As rich does; also for what is not a string, for example a `Text`."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text))


out, errors = Console(), Console(stderr=True)


def print_json(value: Any) -> None:
    """Print a value as indented JSON; whole numbers of a table are integers."""
    out.print_json(json.dumps(value, default=_number))


def tell(facts: Mapping[str, Any], text: str, *, as_json: bool) -> None:
    """Print what a verb has done: a line of JSON for a script, or a text."""
    out.print(json.dumps(facts, default=_number) if as_json else text, soft_wrap=True, lines=True)


def _number(value: Any) -> int | float:
    if not isinstance(value, Decimal):
        raise TypeError(f"{type(value).__name__} has no form in JSON")
    return int(value) if value == value.to_integral_value() else float(value)
