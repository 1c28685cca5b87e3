"""What every spool does: order, bound, policies. In memory and on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from iort_agent.spool import OVERWRITE_OLDEST, REJECT_NEW, Spool
from iort_agent.spool.memory import MemorySpool
from iort_agent.spool.sqlite import SqliteSpool
from testkit.agent import ManualClock

if TYPE_CHECKING:
    MakeSpool = Callable[..., Spool]

BOOT = "0badcafe0badcafe"


@pytest.fixture(params=["memory", "sqlite"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[MakeSpool]:
    made: list[Spool] = []

    def make_one(**settings: Any) -> Spool:
        if request.param == "memory":
            made.append(MemorySpool(**settings))
        else:
            made.append(SqliteSpool(tmp_path / "spool.db", clock=ManualClock(), **settings))
        return made[-1]

    yield make_one
    for spool in made:
        spool.close()


def fill(
    spool: Spool, count: int, size: int = 10, *, stream: str = "vesc", first: int = 0, boot: str = BOOT
) -> None:
    for seq in range(first, first + count):
        spool.put(stream, boot, seq, b"x" * size, samples=5)


def work(spool: Spool) -> None:
    """What the spool's thread does."""
    if isinstance(spool, SqliteSpool):
        spool.work()


def following(spool: Spool, after: int) -> Any:
    """The next batch, once it is to hand."""
    for _ in range(2):
        entry = spool.next(after)
        if entry is not None:
            return entry
        work(spool)
    return spool.next(after)


def kept(spool: Spool) -> list[int]:
    out, after = [], 0
    while (entry := following(spool, after)) is not None:
        out.append(entry.seq)
        after = entry.id
    return out


def test_keeps_in_order_until_acknowledged(make: MakeSpool) -> None:
    spool = make(max_bytes=1000)
    fill(spool, 3)
    first = following(spool, 0)
    assert first == (1, "vesc", 0, b"x" * 10, 5)
    assert spool.next(0) == first, "looking does not take"
    spool.ack(first.id)
    spool.ack(first.id)
    assert kept(spool) == [1, 2]
    assert spool.backlog() == (2, 10, 20)
    assert spool.alarm is None


def test_tells_when_there_is_a_batch(make: MakeSpool) -> None:
    spool = make(max_bytes=1000)
    found: list[Any] = []
    spool.on_stored(lambda: found.append(spool.next(0)))
    fill(spool, 1)
    if isinstance(spool, SqliteSpool):
        assert found == [], "not before it is durable"
        spool.work()
    assert [entry.seq for entry in found] == [0]


@pytest.mark.parametrize(("policy", "left"), [(OVERWRITE_OLDEST, [7, 8, 9]), (REJECT_NEW, [0, 1, 2])])
@pytest.mark.parametrize("at_once", [True, False])
def test_drops_as_the_policy_says(make: MakeSpool, policy: str, left: list[int], at_once: bool) -> None:
    spool = make(max_bytes=35, policy=policy)
    for seq in range(10):
        fill(spool, 1, first=seq)
        if not at_once:
            work(spool)
    assert kept(spool) == left
    assert spool.dropped() == (7, 35)
    assert spool.backlog() == (3, 15, 30)


@pytest.mark.parametrize("policy", [OVERWRITE_OLDEST, REJECT_NEW])
def test_a_batch_larger_than_the_spool_does_not_empty_it(make: MakeSpool, policy: str) -> None:
    spool = make(max_bytes=35, policy=policy)
    fill(spool, 2)
    fill(spool, 1, size=36, first=2)
    assert kept(spool) == [0, 1]
    assert spool.dropped() == (1, 5)


def test_room_comes_back_with_acknowledgements(make: MakeSpool) -> None:
    spool = make(max_bytes=20, policy=REJECT_NEW)
    for _ in range(10):
        fill(spool, 2)
        while (entry := following(spool, 0)) is not None:
            spool.ack(entry.id)
    assert spool.dropped() == (0, 0)
    assert spool.backlog() == (0, 0, 0)


def test_a_stream_has_told_of_the_runs_before_when_a_batch_of_it_has_arrived(make: MakeSpool) -> None:
    spool = make(max_bytes=1000)
    fill(spool, 1)
    fill(spool, 1, stream="rtt")
    assert spool.previous("vesc") == spool.previous("rtt") == ()
    spool.ack(following(spool, 0).id)
    assert spool.previous("vesc") is None
    assert spool.previous("rtt") == ()
