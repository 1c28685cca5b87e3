"""Prints texts that may come from robots: a terminal obeys no character of them.

An escape sequence in a name or a value could move the cursor, hide a line or write the operator's clipboard
(OSC 52). So every control character is shown as the text of its code. Characters that change the
direction of a line are shown so too, and no text is rich's markup. A line break is shown so as well: a
robot's text must not begin a line, which would look like one of ours. `Lines` is a text of ours with lines.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from decimal import Decimal
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from rich import console
from rich.json import JSON
from rich.measure import Measurement
from rich.segment import Segment
from rich.text import Text

from iort_station.output import one_line, visible

_Row = TypeVar("_Row")


class Lines:
    """A text of our own, which may have several lines. What it has of robots must be `one_line`."""

    def __init__(self, text: str | Text, end: str = "\n") -> None:
        self._text = Text(visible(text), end=end) if isinstance(text, str) else text

    def __rich_console__(self, to: console.Console, options: console.ConsoleOptions) -> Iterable[Segment]:
        return self._text.__rich_console__(to, options)

    def __rich_measure__(self, to: console.Console, options: console.ConsoleOptions) -> Measurement:
        return Measurement.get(to, options, self._text)


class Console(console.Console):
    """rich's console without control characters in the content. A style is an argument or a `Text`."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**{"highlight": False, "markup": False, "emoji": False, **given})

    def print_json(self, json: str | None = None, **given: Any) -> None:
        """As rich does."""
        self.print(Lines(JSON(json or "null", **given).text), soft_wrap=True)

    def render_str(self, text: str, **given: Any) -> Text:
        """As rich does, in one line; before the layout, which counts characters."""
        return super().render_str(one_line(text), **given)

    def render(
        self, renderable: console.RenderableType, options: console.ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As rich does; also for what is not a string, for example a `Text`."""
        if isinstance(renderable, Text) and "\n" in renderable.plain:
            # With the styles of its parts.
            renderable = renderable.blank_copy(r"\n").join(renderable.split(allow_blank=True))
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=visible(segment.text))


out, errors = Console(), Console(stderr=True)


def print_json(value: Any) -> None:
    """Print a value as indented JSON; whole numbers of a table are integers."""
    out.print_json(json.dumps(value, default=_number))


def tell(
    facts: Any, text: str | Lines | Callable[[], object], *, as_json: bool, indented: bool = False
) -> None:
    """Print what a verb has done or found: JSON for a script, in a line or ``indented``; or a text, or what a
    function prints."""
    if as_json and indented:
        print_json(facts)
    elif as_json:
        out.print(json.dumps(facts, default=_number), soft_wrap=True)
    elif callable(text):
        text()
    else:
        out.print(text, soft_wrap=True)


def listing(
    rows: Iterable[_Row],
    facts: Callable[[_Row], Mapping[str, Any]],
    show: Callable[[_Row], object],
    *,
    as_json: bool,
    none: str = "",
) -> int:
    """Print rows, as one list of JSON or each by ``show``, and return how many there are; ``none`` says on
    standard error that there are none."""
    count = 0
    if as_json:
        told = [facts(row) for row in rows]
        print_json(told)
        return len(told)
    for count, row in enumerate(rows, 1):  # noqa: B007 - counts what may be an iterator
        show(row)
    if not count and none:
        errors.print(none, soft_wrap=True)
    return count


def counted(count: int, what: str) -> str:
    """A number of things: 1 drive, 2 drives."""
    return f"{count:,} {what}" if count == 1 else f"{count:,} {what}s"


def table(*head: str, left: Sequence[str] = (), title: str | None = None, wrap: bool = False) -> Table:
    """A table without lines, of numbers except in the columns ``left``; with ``wrap``, a cell may take
    several lines."""
    # It takes longer to load than TAB may take.
    from rich.table import Table  # noqa: PLC0415 - see above

    shown = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for name in head:
        justify: Literal["left", "right"] = "left" if name in left else "right"
        shown.add_column(name, justify=justify, no_wrap=not wrap, overflow="fold")
    return shown


def _number(value: Any) -> int | float:
    if not isinstance(value, Decimal):
        raise TypeError(f"{type(value).__name__} has no form in JSON")
    return int(value) if value == value.to_integral_value() else float(value)


# Progress on standard error: a bar, if somebody looks.

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn
    from rich.table import Table

    from iort_analysis.archive.stored import PageProgress

# A bar that would be gone sooner is not shown.
_PATIENCE_S = 1.0


@contextmanager
def bar(title: str, total: float | None, *columns: ProgressColumn) -> Iterator[Callable[[float], None]]:
    """Show a bar; the function given adds to what is done."""
    progress = _progress(*columns)
    task = progress.add_task(title, total=total)
    try:
        if errors.is_terminal:
            progress.start()
        yield lambda more: progress.advance(task, more)
    finally:
        _stop(progress)


@contextmanager
def reading(title: str, start_us: int | None, end_us: int | None) -> Iterator[PageProgress]:
    """Show how much of a range has been read, if that takes longer than a second."""
    if not errors.is_terminal:
        yield lambda _more, _last_us: None
        return
    # It takes longer to load than a minute of samples to read.
    from rich.progress import TextColumn  # noqa: PLC0415 - see above

    progress = _progress(TextColumn("{task.fields[items]:,} items"))
    range_us = (start_us, end_us - start_us) if start_us is not None and end_us is not None else None
    task = progress.add_task(title, total=1.0 if range_us else None, items=0)
    began, items = time.monotonic(), 0

    def tell(more: int, last_us: int) -> None:
        nonlocal items
        items += more
        share = (last_us - range_us[0]) / max(1, range_us[1]) if range_us else 0.0
        progress.update(task, completed=min(1.0, max(0.0, share)), items=items)
        if time.monotonic() - began > _PATIENCE_S:
            progress.start()

    try:
        yield tell
    finally:
        _stop(progress)


def _progress(*columns: ProgressColumn) -> Progress:
    from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415 - as above

    shown = (TextColumn("{task.description}", markup=False), BarColumn(), *columns)
    return Progress(*shown, console=errors, transient=True)


def _stop(progress: Progress) -> None:
    # Where nothing was shown, rich would print an empty line.
    if progress.live.is_started:
        progress.stop()
