"""Judges what the viewers saw against what the robot recorded: how old each picture was on the screen, when
pictures came again, and whether a command passed whose driver saw a late picture, or none."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

from iort_agent.control.commands import ACCEPTED

S = 1_000_000


class Shown(NamedTuple):
    """A picture on a viewer's screen: when, by the machine's clock, and its number as the picture shows it;
    None if it cannot be read. ``held_ms`` is how long the viewer had its last packet by then, if that is
    known, and ``early_ms`` how long before it the page was told of it."""

    shown_us: int
    number: int | None
    held_ms: float | None = None
    early_ms: float = 0.0


class Said(NamedTuple):
    """What the page itself says beside the picture: its state, the picture's number, and its age."""

    at_us: int
    state: str
    number: int
    age_ms: float


class Motion(NamedTuple):
    """A sample of the robot's stream of commands: when the command came, and what became of it."""

    at_us: int
    seq: int
    outcome: str
    frame: int | None
    frame_age_ms: float | None
    blind: bool
    drives: bool

    @property
    def passed(self) -> bool:
        """Whether it moves the robot, or lets it stand with a lease; one that ends its lease does not."""
        return self.outcome == ACCEPTED and self.drives


def motions(times_us: Sequence[int], columns: Mapping[str, Sequence[Any]]) -> list[Motion]:
    """The samples of a query, in order of time."""

    def number(value: Any) -> float | None:
        # A null is None among texts, and not a number among numbers.
        return None if value is None or value != value else float(value)  # noqa: PLR0124 - NaN

    rows = zip(
        times_us,
        *(columns[name] for name in ("seq", "outcome", "frame", "frame_age_ms", "blind", "driver")),
        strict=True,
    )
    return [
        Motion(
            int(at_us),
            int(seq),
            str(outcome),
            None if (frame_ := number(frame)) is None else int(frame_),
            number(age_ms),
            bool(blind),
            isinstance(driver, str),
        )
        for at_us, seq, outcome, frame, age_ms, blind, driver in rows
    ]


def ages_ms(
    shown: Sequence[Shown], captured: Mapping[int, int], span: tuple[int, int] | None = None
) -> list[float]:
    """The age of each picture when it came onto the screen; those of a time, if it is given."""
    return [
        (one.shown_us - captured[one.number]) / 1000
        for one in shown
        if one.number in captured and (span is None or span[0] <= one.shown_us <= span[1])
    ]


def live_share(
    shown: Sequence[Shown], captured: Mapping[int, int], span: tuple[int, int], limit_ms: float
) -> float:
    """The share of a time at which the newest picture on the screen was younger than the limit."""
    known = [one for one in shown if one.number in captured and one.shown_us <= span[1]]
    ends = [*(one.shown_us for one in known[1:]), span[1]]
    live_us = 0.0
    for one, next_us in zip(known, ends, strict=True):
        late_us = captured[one.number] + limit_ms * 1000  # type: ignore[index]  # a known one has a number
        live_us += max(0.0, min(next_us, late_us) - max(one.shown_us, span[0]))
    return live_us / (span[1] - span[0])


def again_s(shown: Sequence[Shown], captured: Mapping[int, int], at_us: int, limit_ms: float) -> float | None:
    """After how long a picture was on the screen that was captured after ``at_us`` and is not late; None if
    none came."""
    for one in shown:
        if one.number not in captured or one.shown_us < at_us:
            continue
        age_ms = (one.shown_us - captured[one.number]) / 1000
        if captured[one.number] >= at_us and age_ms <= limit_ms:
            return (one.shown_us - at_us) / 1e6
    return None


def said_again_s(said: Sequence[Said], captured: Mapping[int, int], at_us: int) -> float | None:
    """After how long the page called a picture live that was captured after ``at_us``; None if it did not."""
    for one in said:
        if one.at_us >= at_us and one.state == "live" and captured.get(one.number, 0) >= at_us:
            return (one.at_us - at_us) / 1e6
    return None


def said_wrong_ms(said: Sequence[Said], captured: Mapping[int, int]) -> list[float]:
    """By how much each age that the page told is more than the true age of its picture."""
    return [one.age_ms - (one.at_us - captured[one.number]) / 1000 for one in said if one.number in captured]


def longest_gap_ms(shown: Sequence[Shown], span: tuple[int, int]) -> float:
    """The longest time without a new picture."""
    times = [span[0], *(one.shown_us for one in shown if span[0] < one.shown_us < span[1]), span[1]]
    return max(after - before for before, after in pairwise(times)) / 1000


def struck(commands: Sequence[Motion], captured: Mapping[int, int], span: tuple[int, int]) -> dict[int, int]:
    """The capture time of the picture at which a thread was struck, if it had no time to record it: it is on
    the screen, and the robot's word of its age is in the commands of the time. At most one a strike."""
    for one in commands:
        known = one.frame is None or one.frame in captured or one.frame_age_ms is None
        if span[0] <= one.at_us < span[1] and not known:
            return {one.frame: one.at_us - round(one.frame_age_ms * 1000)}
    return {}


@dataclass(frozen=True)
class Verdict:
    """The commands of a time: how many passed, and those that must not have passed, each with why."""

    passed: int
    refused: int
    last_ms: float | None
    wrong: tuple[str, ...]


def judge(
    commands: Sequence[Motion],
    shown: Sequence[Shown],
    captured: Mapping[int, int],
    limit_ms: float,
    span: tuple[int, int],
    *,
    screen_ms: float = 0.0,
    slack_ms: float = 0.0,
) -> Verdict:
    """Judge the commands of a time. ``last_ms`` is when the last one passed, from its begin.

    By the robot's word: the picture was known, and not late. By the screen, which the robot does not see: the
    picture that the command names was on it, or a later one, and the newest there was not late when the
    command came.
    ``screen_ms`` is how exactly a browser tells when a picture is on the screen, ``slack_ms`` how exactly
    a sample tells when its command came.
    """
    on_screen: dict[int, int] = {}
    for one in shown:
        if one.number is not None:
            on_screen.setdefault(one.number, one.shown_us - round(one.early_ms * 1000))
    newest = sorted((at_us, number) for number, at_us in on_screen.items())
    # When a picture or a later one was on it: on a busy machine one is overtaken before it is read there.
    numbers = sorted(on_screen)
    by_us = list(accumulate((on_screen[number] for number in reversed(numbers)), min))[::-1]
    own = [one for one in commands if span[0] <= one.at_us < span[1]]
    passed = [one for one in own if one.passed]
    wrong = []
    for one in passed:
        why = []
        if one.blind:
            why.append("blind")
        if one.frame is None or one.frame_age_ms is None:
            why.append(f"names picture {one.frame}, of age {one.frame_age_ms} ms")
        else:
            if one.frame_age_ms > limit_ms:
                why.append(f"its picture was {one.frame_age_ms:.0f} ms old")
            place = bisect_left(numbers, one.frame)
            if place == len(numbers) or by_us[place] > one.at_us + screen_ms * 1000:
                unread = sum(each.number is None and 0 <= one.at_us - each.shown_us < S for each in shown)
                why.append(f"picture {one.frame} was not on the screen, {unread} of its second unread")
        last = bisect_right(newest, (one.at_us + round(screen_ms * 1000), 2**63)) - 1
        seen = newest[last][1] if last >= 0 else None
        age_ms = (one.at_us - captured[seen]) / 1000 if seen in captured else None
        if age_ms is None or age_ms > limit_ms + slack_ms:
            why.append(f"the newest on the screen, {seen}, was {age_ms} ms old")
        if why:
            wrong.append(f"command {one.seq}: {', '.join(why)}")
    last_ms = (passed[-1].at_us - span[0]) / 1000 if passed else None
    return Verdict(len(passed), len(own) - len(passed), last_ms, tuple(wrong))
