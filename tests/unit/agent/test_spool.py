"""What every spool does: order, bound, policies. In memory and on disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from iort_agent.spool.memory import OVERWRITE_OLDEST, REJECT_NEW, MemorySpool, Spool
from iort_agent.spool.sqlite import SqliteSpool
from tests.agent_fakes import ManualClock

if TYPE_CHECKING:
    MakeSpool = Callable[..., Spool]


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


def fill(spool: Spool, count: int, size: int = 10, stream: str = "vesc") -> None:
    for _ in range(count):
        spool.put(stream, spool.next_seq(stream), b"x" * size, samples=5)


def following(spool: Spool, after: int) -> Any:
    """The next batch, once it is to hand."""
    entry = spool.next(after)
    if entry is None and isinstance(spool, SqliteSpool):
        spool.flush()
        entry = spool.next(after)
        if entry is None:
            spool.flush()
            entry = spool.next(after)
    return entry


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


def test_numbers_each_stream_by_itself(make: MakeSpool) -> None:
    spool = make(max_bytes=1000)
    fill(spool, 2, stream="vesc")
    fill(spool, 1, stream="rtt")
    fill(spool, 1, stream="vesc")
    assert kept(spool) == [0, 1, 0, 2]


def test_tells_when_there_is_a_batch(make: MakeSpool) -> None:
    spool = make(max_bytes=1000)
    found: list[Any] = []
    spool.on_stored(lambda: found.append(spool.next(0)))
    fill(spool, 1)
    if isinstance(spool, SqliteSpool):
        assert found == [], "not before it is durable"
        spool.flush()
    assert [entry.seq for entry in found] == [0]


@pytest.mark.parametrize(("policy", "left"), [(OVERWRITE_OLDEST, [7, 8, 9]), (REJECT_NEW, [0, 1, 2])])
def test_drops_as_the_policy_says(make: MakeSpool, policy: str, left: list[int]) -> None:
    spool = make(max_bytes=35, policy=policy)
    fill(spool, 10)
    assert kept(spool) == left
    assert spool.dropped() == spool.dropped_ever() == (7, 35)
    assert spool.backlog().payload_bytes == 30
    assert spool.next_seq("vesc") == 10, "the numbers of dropped batches are not used again"


@pytest.mark.parametrize("policy", [OVERWRITE_OLDEST, REJECT_NEW])
def test_a_batch_larger_than_the_spool_does_not_empty_it(make: MakeSpool, policy: str) -> None:
    spool = make(max_bytes=35, policy=policy)
    fill(spool, 2)
    fill(spool, 1, size=36)
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
