"""Writes the table of the questions into docs/explanation/assumptions.md: `python -m verify.page`.

The page's second table, of the behaviours that no program asks, is written by hand and stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator

from local.deployment import ROOT
from testkit.command import Table
from verify import report
from verify.question import Question, compared
from verify.questions import ALL
from verify.report import Measured

PAGE = ROOT / "docs" / "explanation" / "assumptions.md"
BY_HAND = "## Not asked\n"
_HEAD = ["behaviour", "what we rely on", "basis", "relied on by", "embedded cloud"]
_INTRODUCTION = """\
# The design's assumptions about AWS

Each row is a behaviour of AWS that the code relies on and that the embedded cloud imitates. *Documented*
names AWS' page. *Assumed* means that AWS does not document it. *Measured* means that `make verify-aws` has
seen it in an account; tests/local/emulator/test_verify.py then expects the same answer from the embedded
cloud.
How to ask your own account: [deploy](../how-to/deploy.md#ask-your-account). `python -m verify.page`
writes the first table from verify/questions/; the second is written by hand.
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(text(report.load(), PAGE.read_text()))


def text(known: Measured, page: str) -> str:
    """The whole page, with the part of ``page`` that is written by hand."""
    _, heading, by_hand = page.partition(BY_HAND)
    return "\n".join((*_generated(known, len(rows(by_hand))), "", heading + by_hand))


def rows(by_hand: str) -> list[list[str]]:
    """The cells of each row of a page's table."""
    lines = [line for line in by_hand.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def _generated(known: Measured, not_asked: int) -> Iterator[str]:
    yield _INTRODUCTION
    count = sum(one.name in known.seen for one in ALL)
    yield (
        f"`make verify-aws` asks {len(ALL)} of {len(ALL) + not_asked} behaviours. {count} were "
        f"measured{f' by {known.by} on {known.date} in {known.region}' if known.seen else ''}."
    )
    yield ""
    yield "## Asked by `make verify-aws`"
    yield ""
    cells = [
        [f"`{one.name}`", one.assumed, _basis(one, known), ", ".join(one.relied_on_by), _embedded(one)]
        for one in ALL
    ]
    yield Table("", _HEAD, cells).as_markdown()


def _basis(one: Question, known: Measured) -> str:
    if one.name in known.seen:
        same = compared(known.seen[one.name]) == one.expected
        return f"measured ({'as assumed' if same else 'differs'})"
    return f"documented: {one.source}" if one.source else "assumed"


def _embedded(one: Question) -> str:
    return f"not asked: {one.not_embedded}" if one.not_embedded else "asked in every test run"


if __name__ == "__main__":
    main()
