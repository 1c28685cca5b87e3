"""The network that the proof of video drives through: it does what it is told, and only that."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest

from testkit.namespaces import NoNamespacesError
from testkit.waiting import GUARD_S, until
from testkit.wire import Conditions, Way, Wire

MANY = 10_000
_FIRST, _LAST = 2**32 - 2, 2**32 - 1


def way(**conditions: float) -> Way:
    made = Way(seed=7)
    made.conditions = Conditions(**conditions)  # type: ignore[arg-type]  # numbers alone
    return made


def test_every_frame_comes_after_the_delay() -> None:
    assert [way(delay_ms=25).due(at, 1200) for at in (0.0, 1.5)] == [0.025, 1.525]


def test_as_many_are_lost_as_told_and_the_same_ones_in_each_run() -> None:
    once = [way_.due(float(i), 1200) is None for way_ in (way(loss=0.05),) for i in range(MANY)]
    again = [way_.due(float(i), 1200) is None for way_ in (way(loss=0.05),) for i in range(MANY)]
    assert once == again
    assert sum(again) == pytest.approx(MANY * 0.05, rel=0.1)


def test_a_narrow_line_passes_its_rate_and_lets_nobody_wait_for_longer_than_its_queue() -> None:
    line = way(kbit_s=1000, queue_ms=100, delay_ms=10)
    # 1,000 bytes each ms are eight times its rate.
    came = [(at, line.due(at, 1000)) for at in (i / 1000 for i in range(1000))]
    passed = [(at, due) for at, due in came if due is not None]
    took = (1000 + 24) * 8 / 1_000_000
    assert len(passed) == line.passed == pytest.approx((1.0 + 0.1) / took, abs=2)
    assert line.dropped == 1000 - len(passed)
    assert max(due - at for at, due in passed) <= 0.1 + took + 0.01 + 1e-9
    assert min(after - before for (_, before), (_, after) in pairwise(passed)) >= took - 1e-9


def test_a_cut_line_passes_nothing() -> None:
    cut = way(cut=True)
    assert [cut.due(float(i), 100) for i in range(10)] == [None] * 10
    assert cut.lost == 10


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Wire]:
    made = Wire(tmp_path_factory.mktemp("wire"))
    try:
        made.__enter__()
    except NoNamespacesError as error:
        pytest.skip(str(error))
    yield made
    made.__exit__()


class Ends:
    """A socket on each machine, which know each other's addresses."""

    def __init__(self, wire: Wire, port: int) -> None:
        self.to = (wire.other.address, port)
        self.sender = wire.one.socket(socket.SOCK_DGRAM, bind=(wire.one.address, port))
        self.receiver = wire.other.socket(socket.SOCK_DGRAM, bind=(wire.other.address, port))

    def known(self) -> None:
        """Wait until they know each other: who has an address is asked first."""
        until(lambda: self.send(_FIRST) or self.next(1.0) is not None, "the first frame")
        # After a while without an answer it was sent again, and comes late.
        self.send(_LAST)
        until(lambda: self.next(GUARD_S) == _LAST, "the last of them")

    def send(self, number: int) -> None:
        self.sender.sendto(number.to_bytes(4, "big") + bytes(996), self.to)

    def next(self, within_s: float) -> int | None:
        if not select.select([self.receiver], [], [], within_s)[0]:
            return None
        return int.from_bytes(self.receiver.recv(2000)[:4], "big")


@pytest.fixture
def ends(wire: Wire, request: pytest.FixtureRequest) -> Iterator[Ends]:
    wire.set(delay_ms=0.0, loss=0.0, kbit_s=0.0, cut=False)
    made = Ends(wire, 5000 + len(request.node.name))
    made.known()
    yield made
    made.sender.close()
    made.receiver.close()


def test_frames_between_machines_come_no_sooner_than_the_delay(wire: Wire, ends: Ends) -> None:
    wire.set(delay_ms=20)
    took = []
    for number in range(50):
        began = time.monotonic()
        ends.send(number)
        assert ends.next(GUARD_S) == number
        took.append(time.monotonic() - began)
    assert min(took) >= 0.02


def test_those_that_are_lost_are_counted(wire: Wire, ends: Ends) -> None:
    wire.set(loss=0.3)
    before = wire.counts()
    arrived = 0
    for number in range(200):
        ends.send(number)
        arrived += ends.next(0.01) is not None
    after = until(lambda: (now := wire.counts())["passed"] + now["lost"] >= 200 + sum_of(before) and now)
    arrived += sum(1 for _ in iter(lambda: ends.next(0.2), None))
    # Others may ask for an address meanwhile.
    assert arrived == pytest.approx(after["passed"] - before["passed"], abs=10)
    assert arrived == pytest.approx(200 * 0.7, rel=0.2)


def sum_of(counts: dict[str, int]) -> int:
    return counts["passed"] + counts["lost"]


def test_nothing_passes_a_cut_and_all_passes_after_it(wire: Wire, ends: Ends) -> None:
    wire.set(cut=True)
    for number in range(20):
        ends.send(number)
    assert ends.next(0.5) is None
    wire.set(cut=False)
    for number in range(20):
        ends.send(100 + number)
        assert ends.next(GUARD_S) == 100 + number


def test_a_stream_of_tcp_comes_whole_through_loss(wire: Wire, ends: Ends) -> None:
    wire.set(loss=0.02, delay_ms=2)
    content = bytes(range(256)) * 800
    with (
        wire.one.socket() as client,
        wire.other.socket(bind=(wire.other.address, 6000), listen=True) as server,
    ):
        client.connect((wire.other.address, 6000))
        accepted, _ = server.accept()
        with accepted, accepted.makefile("rb") as heard:
            client.sendall(content)
            client.shutdown(socket.SHUT_WR)
            assert heard.read() == content
