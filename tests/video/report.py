"""The proof's figures as text and as a file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from local.figures import Spread
from tests.video.proof import LIMIT_MS, RECOVERY_S, TARGETS_MS, Figures


def report(figures: Figures) -> str:
    """The tables."""
    parts = [_glass(figures), _bad(figures), _recovery(figures), _tries(figures), _lanes(figures)]
    return "\n\n".join(part for part in parts if part)


def kept(content: Mapping[str, Any], path: Path) -> None:
    """Write the figures."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, default=str) + "\n")


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    cells = (
        "  ".join(f"{cell:{'>' if i else '<'}{widths[i]}}" for i, cell in enumerate(line)) for line in lines
    )
    return "\n".join([title, *cells])


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _glass(figures: Figures) -> str:
    rows = [
        [f"{viewer}, {rtt} ms", str(spread.n), _ms(spread.p50), _ms(spread.p95), f"{target:.0f}",
         "yes" if spread.p95 is not None and spread.p95 <= target else "no"]
        for viewer, spreads in figures.glass.items()
        for rtt, spread in spreads.items()
        for target in (TARGETS_MS[rtt],)
    ]  # fmt: skip
    head = ("viewer, round trip", "pictures", "p50 ms", "p95 ms", "target", "reached")
    return _table("From the capture to the screen", head, rows)


def _bad(figures: Figures) -> str:
    rows = [
        [
            f"{one['viewer']}, {one['network']}",
            str(one["kbit_s"]),
            str(one["pictures_hz"]),
            _ms(one["age_ms"]["p50"]),
            _ms(one["age_ms"]["p95"]),
            _ms(one["held_ms"]["p50"]),
            f"{one['live_share']:.1%}",
            _ms(one["longest_gap_ms"]),
        ]
        for one in figures.bad
    ]
    head = (
        "viewer, network",
        "kbit/s",
        "a second",
        "age p50 ms",
        "p95 ms",
        "held ms",
        "live",
        "longest gap ms",
    )
    return _table(f"Pictures by network; live is younger than {LIMIT_MS} ms", head, rows)


def _recovery(figures: Figures) -> str:
    rows = [
        [viewer, str(len(found)), "  ".join("never" if one is None else f"{one:.2f}" for one in found)]
        for viewer, found in figures.recovery_s.items()
    ]
    if figures.page_again_s:
        told = ["never" if one is None else f"{one:.2f}" for one in figures.page_again_s]
        rows.append(["the page's own word", str(len(told)), "  ".join(told)])
    title = f"From the end of a cut to a live picture, in s; target {RECOVERY_S:g}"
    return _table(title, ("viewer", "cuts", "s"), rows) if rows else ""


def _tries(figures: Figures) -> str:
    rows = []
    for failure in dict.fromkeys(one.failure for one in figures.tries):
        own = [one for one in figures.tries if one.failure == failure and one.verdict is not None]
        last = [one.verdict.last_ms for one in own if one.verdict and one.verdict.last_ms is not None]
        again = Spread.of([one.again_s for one in own if one.again_s is not None])
        rows.append(
            [
                failure,
                str(len(own)),
                str(sum(one.driven for one in own)),
                _ms(max(last, default=None)),
                str(sum(len(one.verdict.wrong) for one in own if one.verdict)),
                _ms(max((one.gap_ms for one in own), default=None)),
                "-" if again.p95 is None else f"{again.p50:.1f} (p95 {again.p95:.1f})",
            ]
        )
    head = (
        "failure",
        "tries",
        "passed before",
        "last after ms",
        "wrong",
        "longest gap ms",
        "live again s",
    )
    whole = figures.whole
    wrong = figures.age_wrong_ms
    told = f"{whole.passed} commands passed, {len(whole.wrong)} wrong" if whole else ""
    told += f"; the page tells an age that is {_ms(wrong.p50)} ms too high (p95 {_ms(wrong.p95)}), {wrong.n}"
    if figures.by_broker:
        told += f"; {figures.by_broker} passed by pictures over the broker"
    return "\n".join([_table("Commands when the picture froze", head, rows), told])


def _lanes(figures: Figures) -> str:
    rows = [[one["block"], *(_spread(one[lane]) for lane in ("record", "live"))] for one in figures.lanes]
    return _table("The lanes' delay in ms, p50 (p95)", ("viewer", "record", "live"), rows)


def _spread(values: Mapping[str, Any]) -> str:
    return f"{_ms(values['p50'])} ({_ms(values['p95'])}), {values['n']}"
