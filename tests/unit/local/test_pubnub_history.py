"""The history of PubNub's stand-in, and its bounds."""

from __future__ import annotations

from local.pubnub import History, Message, Subscription


def message(token, channel, size=1):
    return Message(token, channel, "", "x" * size)


def test_the_history_keeps_the_newest_messages_of_a_channel():
    history = History()
    for token in range(1, 251):
        history.add(message(token, "a"))
    tokens = [kept.token for _, kept in history.after(0, Subscription(["a"]))]
    assert tokens == list(range(151, 251))


def test_the_history_is_bounded_in_channels_and_bytes():
    history, everything = History(channels=3, size_bytes=10), Subscription(["c.*"])
    for token in range(1, 6):
        history.add(message(token, f"c.{token}"))
    assert [kept.token for _, kept in history.after(0, everything)] == [3, 4, 5]
    history.add(message(6, "c.6", 9))
    assert [kept.token for _, kept in history.after(0, everything)] == [5, 6]
    history.add(message(7, "c.7", 1000))
    assert [kept.token for _, kept in history.after(0, everything)] == [7]


def test_messages_dropped_from_a_channel_free_their_bytes():
    history = History(size_bytes=1_000)
    history.add(message(1, "quiet"))
    for token in range(2, 500):
        history.add(message(token, "busy", 5))
    assert [kept.token for _, kept in history.after(0, Subscription(["quiet"]))] == [1]


def test_an_answer_is_bounded_and_its_cursor_continues():
    history, wanted = History(), Subscription(["c.*"])
    for token in range(1, 301):
        history.add(message(token, f"c.{token % 4}"))
    first = [kept.token for _, kept in history.after(0, wanted)]
    rest = [kept.token for _, kept in history.after(first[-1], wanted)]
    assert first == list(range(1, 101))
    assert rest == list(range(101, 201))
