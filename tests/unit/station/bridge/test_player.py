"""The playhead, what is read ahead of it, and what cancels that."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator

import pytest
from foxglove.websocket import PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus

from iort_station.bridge.channels import Level, Message, Topic
from iort_station.bridge.player import FASTEST, Player
from iort_station.bridge.stored import Cancelled, Source
from iort_station.errors import StationError
from testkit.waiting import GUARD_S, until

SECOND = 10**9
TOPIC = Topic("/t", "json", "t", "jsonschema", b"{}")


class Request:
    """What the sdk gives; its own cannot be made in Python."""

    def __init__(
        self, *, play: bool, seek_ns: int | None = None, speed: float = FASTEST, name: str = ""
    ) -> None:
        self.playback_command = PlaybackCommand.Play if play else PlaybackCommand.Pause
        self.playback_speed, self.seek_time, self.request_id = speed, seek_ns, name


class Audience:
    """Keeps what it gets."""

    def __init__(self, *topics: int) -> None:
        self.topics = frozenset(topics)
        self.got: list[Message] = []
        self.states: list[PlaybackState] = []
        self.said: list[str] = []

    def wanted(self) -> frozenset[int]:
        return self.topics

    def send(self, message: Message) -> None:
        self.got.append(message)

    def tell_time(self, t_ns: int) -> None:
        pass

    def tell_state(self, state: PlaybackState) -> None:
        self.states.append(state)

    def say(self, text: str, level: Level = "warning", *, name: str | None = None) -> None:
        self.said.append(text)

    def unsay(self, name: str) -> None:
        self.said.append(f"not {name}")

    def ended(self) -> bool:
        return any(state.status == PlaybackStatus.Ended for state in list(self.states))


class Ticks(Source):
    """A message of each topic each second, for ``seconds``. ``hold`` is asked before each page of ten."""

    def __init__(self, seconds: int, topics: int = 1, hold: Callable[[int], None] = lambda _i: None) -> None:
        self.topics = [TOPIC] * topics
        self.start_ns, self.end_ns = 0, seconds * SECOND
        self._hold = hold
        self.read_from: list[int] = []
        self.closed = 0

    def messages(
        self,
        start_ns: int,
        wanted: frozenset[int],
        check: Callable[[], None],
        _say: Callable[[str], None],
    ) -> Generator[Message, None, None]:
        self.read_from.append(start_ns)
        try:
            for i in range(-(-start_ns // SECOND), self.end_ns // SECOND):
                if i % 10 == 0:
                    self._hold(i)
                    check()
                for topic in sorted(wanted):
                    yield Message(i * SECOND, topic, b"%d" % i)
        finally:
            self.closed += 1


def control(player: Player, request: Request) -> PlaybackState:
    return player.control(request)  # type: ignore[arg-type]  # as the sdk gives it


def test_every_message_is_sent_once_and_in_order() -> None:
    audience = Audience(0, 1)
    with Player(Ticks(300, topics=2), audience) as player:
        control(player, Request(play=True))
        until(audience.ended)
    assert audience.got == [Message(i * SECOND, topic, b"%d" % i) for i in range(300) for topic in (0, 1)]


def test_what_nobody_subscribes_to_is_not_read() -> None:
    audience, source = Audience(), Ticks(300)
    with Player(source, audience) as player:
        control(player, Request(play=True))
        until(audience.ended)
    assert (audience.got, source.read_from) == ([], [])


def test_a_seek_cancels_what_is_read_and_of_several_the_last_one_counts() -> None:
    waits, goes_on = threading.Event(), threading.Event()

    def hold(i: int) -> None:
        if i == 50:
            waits.set()
            goes_on.wait()

    audience, source = Audience(0), Ticks(600, hold=hold)
    with Player(source, audience) as player:
        control(player, Request(play=True))
        assert waits.wait(GUARD_S)
        # The reader stands in the middle of a page.
        for second in (100, 200, 300, 590):
            state = control(player, Request(play=True, seek_ns=second * SECOND, name=str(second)))
            assert (state.did_seek, state.current_time) == (True, second * SECOND)
        began = len(audience.got)
        goes_on.set()
        until(audience.ended)
        until(lambda: source.closed == 2)
    assert source.read_from == [0, 590 * SECOND]
    assert [message.t_ns // SECOND for message in audience.got[began:]] == list(range(590, 600))
    assert all(message.t_ns < 50 * SECOND for message in audience.got[:began])


def test_a_seek_drops_what_was_about_to_be_sent() -> None:
    class Seeks(Audience):
        def send(self, message: Message) -> None:
            super().send(message)
            if (message.t_ns, message.topic) == (5 * SECOND, 0):
                control(player, Request(play=True, seek_ns=290 * SECOND))

    audience = Seeks(0, 1)
    with Player(Ticks(300, topics=2), audience) as player:
        control(player, Request(play=True))
        until(audience.ended)
    played = [(i, topic) for i in (*range(6), *range(290, 300)) for topic in (0, 1)]
    assert [(one.t_ns // SECOND, one.topic) for one in audience.got] == [
        one for one in played if one != (5, 1)
    ]


def test_another_subscription_goes_on_where_the_playhead_is_and_repeats_nothing() -> None:
    audience, another = Audience(0), threading.Event()

    def hold(i: int) -> None:
        if i == 200:
            another.wait()

    with Player(Ticks(600, topics=2, hold=hold), audience) as player:
        control(player, Request(play=True))
        until(lambda: len(audience.got) > 100)
        audience.topics = frozenset({0, 1})
        player.rewanted(1)
        another.set()
        until(audience.ended)
    times = {topic: [one.t_ns // SECOND for one in audience.got if one.topic == topic] for topic in (0, 1)}
    assert times[0] == list(range(600))
    assert times[1] == list(range(times[1][0], 600))
    assert times[1][0] > 90


def test_while_paused_each_topic_shows_its_first_message_and_who_comes_later_sees_it_too() -> None:
    audience = Audience(0, 1)
    with Player(Ticks(100, topics=2), audience) as player:
        # The first of all are shown at once.
        until(lambda: len(audience.got) == 2)
        audience.got.clear()
        control(player, Request(play=False, seek_ns=40 * SECOND))
        until(lambda: len(audience.got) == 2)
        assert {(one.topic, one.t_ns) for one in audience.got} == {(0, 40 * SECOND), (1, 40 * SECOND)}
        player.rewanted(1)
        until(lambda: len(audience.got) == 3)
        assert audience.got[2] == Message(40 * SECOND, 1, b"40")
        control(player, Request(play=True))
        until(audience.ended)
    after = [(one.t_ns // SECOND, one.topic) for one in audience.got[3:]]
    assert after == [(i, topic) for i in range(41, 100) for topic in (0, 1)]


def test_the_end_does_not_wait_for_a_reading_that_hangs() -> None:
    reads, answers = threading.Event(), threading.Event()

    def hold(_i: int) -> None:
        reads.set()
        answers.wait()

    audience = Audience(0)
    source = Ticks(100, hold=hold)
    with Player(source, audience):
        assert reads.wait(GUARD_S)
    # Without a network it would take minutes. What comes after that goes to nobody.
    assert not source.closed
    answers.set()
    until(lambda: source.closed)
    assert audience.got == []
    assert audience.said == []


@pytest.mark.parametrize("error", [StationError("the table is away"), KeyError("odd")])
def test_a_reading_that_fails_is_told_and_play_goes_on_from_there(
    error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    fails = [error]

    def hold(i: int) -> None:
        if i == 50 and fails:
            raise fails.pop()

    audience = Audience(0)
    with Player(Ticks(100, hold=hold), audience) as player:
        control(player, Request(play=True))
        until(lambda: audience.said)
        assert "play tries again" in audience.said[0]
        until(lambda: audience.states[-1].status == PlaybackStatus.Paused)
        control(player, Request(play=True))
        until(audience.ended)
        until(lambda: audience.said[-1] == "not reading")
    assert [message.t_ns // SECOND for message in audience.got] == list(range(100))
    # What nobody expects has its traceback.
    assert bool(caplog.records[0].exc_info) == isinstance(error, KeyError)


def test_a_reading_that_takes_long_is_told_as_buffering_and_loses_nothing() -> None:
    goes_on = threading.Event()

    def hold(i: int) -> None:
        if i == 50:
            goes_on.wait()

    audience = Audience(0)
    with Player(Ticks(100, hold=hold), audience) as player:
        control(player, Request(play=True))
        until(lambda: any(state.status == PlaybackStatus.Buffering for state in list(audience.states)))
        assert audience.states[-1].current_time <= 50 * SECOND
        goes_on.set()
        until(audience.ended)
    assert [message.t_ns // SECOND for message in audience.got] == list(range(100))


def test_a_check_of_a_cancelled_reading_raises() -> None:
    checks: list[Callable[[], None]] = []

    class Kept(Ticks):
        def messages(self, start_ns, wanted, check, say):  # type: ignore[no-untyped-def]  # as above
            checks.append(check)
            return super().messages(start_ns, wanted, check, say)

    with Player(Kept(10), Audience(0)) as player:
        until(lambda: checks)
        checks[0]()
        control(player, Request(play=False, seek_ns=5))
        with pytest.raises(Cancelled):
            checks[0]()


def test_the_requests_of_the_sdk_are_what_the_player_reads() -> None:
    names = {"playback_command", "playback_speed", "seek_time", "request_id"}
    assert names <= set(dir(PlaybackControlRequest))
