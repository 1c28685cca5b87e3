"""The account of a drive: which missing messages are excused."""

from __future__ import annotations

import pytest

from tests.ros2.proof.account import Account, Contents, Kill, Publisher, Sent, table

S = 10**9
# Ten messages a second; the agent died at 5 s, and the next one was found at 7 s, by message 70.
SENT = [Sent(i * S // 10, b"%04d" % i) for i in range(100)]
KILL = Kill(5 * S, 7 * S)


def account(*missing: int, extra: bytes = b"", back: int | None = 70, named: int = 0, latched: bool = False):
    stored = [one.data for i, one in enumerate(SENT) if i not in missing] + ([extra] if extra else [])
    contents = [Contents({}, {"/t": messages}) for messages in (stored, [one.data for one in SENT])]
    return Account(*contents, KILL).row("/t", "a/msg/B", [Publisher(SENT, back)], named, latched)


@pytest.mark.parametrize(
    ("missing", "dead", "opened", "unexplained"),
    [
        ((), 0, 0, 0),
        (range(50, 70), 20, 0, 0),
        (range(30, 70), 20, 20, 0),
        # Not without a break until the kill, and longer ago than a batch is open.
        ((10, 20), 0, 0, 2),
        ((71,), 0, 0, 1),
    ],
)
def test_only_messages_around_the_kill_are_excused(missing, dead, opened, unexplained):
    row = account(*missing)
    assert (row.missing, row.dead, row.open, row.unexplained) == (len(missing), dead, opened, unexplained)


def test_a_publisher_that_does_not_tell_is_excused_until_all_others_were_back():
    assert account(60, 65, back=None).unexplained == 0
    assert account(75, back=None).unexplained == 1


def test_reported_losses_are_explained_and_repeats_are_not():
    assert account(71, 72, named=2).unexplained == 0
    assert account(extra=b"0000", named=2).unexplained == 1


def test_only_a_latched_message_from_before_the_kill_may_come_twice():
    assert account(extra=b"0049", latched=True).unexplained == 0
    assert account(extra=b"0049").unexplained == 1
    assert account(extra=b"0051", latched=True).unexplained == 1
    assert account(71, extra=b"0049", latched=True).unexplained == 1


def test_the_table_sums_up():
    assert table([account(71), account()]).splitlines()[-1].split() == [
        *("2", "topics", "1", "types", "200", "199", "200", "1", "0", "0", "0", "0", "0", "1"),
    ]  # fmt: skip
