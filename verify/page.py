"""Writes docs/assumptions.md: `python -m verify.page`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from local.deployment import ROOT
from verify import measured
from verify.assumption import Assumption, Basis
from verify.check import Check, compared
from verify.checks import ALL
from verify.measured import Measured
from verify.unasked import UNASKED

PAGE = ROOT / "docs" / "assumptions.md"
_HEAD = """\
# The design's assumptions about AWS

`python -m verify.page` writes this page from verify/. Each row is a behaviour of AWS that the code relies on
and that the embedded cloud imitates. *Documented* names AWS' page. *Assumed* means that AWS does not document
it. *Measured* means that `make verify-aws` has seen it in an account; tests/local/test_verify.py then expects
the same answer from the embedded cloud. How to ask your own account: [cloud.md](cloud.md#ask-your-account).
"""


def main() -> None:
    """Write the page."""
    PAGE.write_text(text(measured.load()))


def text(known: Measured) -> str:
    """The whole page."""
    return "\n".join(_lines(known)) + "\n"


def _lines(known: Measured) -> Iterator[str]:
    yield _HEAD
    count = sum(check.name in known.seen for check in ALL)
    yield (
        f"`make verify-aws` asks {len(ALL)} of {len(ALL) + len(UNASKED)} behaviours. {count} were "
        f"measured{f' by {known.by} on {known.date} in {known.region}' if known.seen else ''}."
    )
    yield ""
    yield "## Asked by `make verify-aws`"
    yield from _table(ALL, known)
    yield ""
    yield "## Not asked"
    yield ""
    yield "A program cannot ask these in half an hour, or only a bill shows them."
    yield from _table(UNASKED, known)


def _table(assumptions: Sequence[Assumption], known: Measured) -> Iterator[str]:
    yield ""
    yield "| behaviour | what we rely on | basis | relied on by | embedded cloud |"
    yield "|---|---|---|---|---|"
    for one in assumptions:
        cells = (
            f"`{one.name}`",
            one.assumed,
            _basis(one, known),
            ", ".join(one.relied_on_by),
            _embedded(one),
        )
        yield f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _basis(one: Assumption, known: Measured) -> str:
    if one.name in known.seen:
        same = isinstance(one, Check) and compared(known.seen[one.name]) == one.expected
        seen = "as assumed" if same else "differs"
        return f"measured ({seen})"
    if one.basis is Basis.DOCUMENTED:
        return f"documented: {one.source}"
    return "assumed"


def _embedded(one: Assumption) -> str:
    if not isinstance(one, Check):
        return "imitated, not asked"
    return f"not asked: {one.not_embedded}" if one.not_embedded else "asked in every test run"


if __name__ == "__main__":
    main()
