"""A recording's batches are those that an agent would make of it: each sample once, and the same again."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from iort_agent.sources.recording import BagConfig
from iort_analysis.archive import columns as names
from iort_analysis.archive.columns import runs
from iort_analysis.archive.writing import Piece
from iort_contract.archive import Hour
from iort_contract.catalog.streams import ACCOUNT_STREAM, TYPES_STREAM
from iort_contract.dynamodb import Item, plain
from iort_contract.limits import MAX_SAMPLES
from iort_contract.messages.account import StreamAccount, account
from iort_contract.messages.batch import MAX_BYTES, batch_id, decode_batch
from iort_contract.recordings.rosbag import Kind, Unread
from iort_contract.ros.message import RosMessage, RosType
from iort_contract.tables import EXPIRES_S, RECEIVED_MS
from iort_station.imports.batches import FIRST_US, Run, Times
from iort_station.imports.choice import Choice
from iort_station.imports.plan import last_us, look
from iort_station.imports.run import _Way
from testkit.agent import ManualClock
from testkit.bags import START_NS, STREAMS, written

SECONDS, RETENTION_S = 4.0, 1000
RUN = "0123456789abcdef"
Samples = dict[str, list[tuple[int, bytes]]]


class Kept:
    """A store that keeps everything."""

    def __init__(self, *, takes_pieces: bool) -> None:
        self.takes_pieces = takes_pieces
        self.stored: dict[str, list[Item]] = defaultdict(list)
        self.pieces: dict[str, list[tuple[Hour, Piece, Sequence[tuple[str, str]]]]] = defaultdict(list)

    def items(self, stream: str, items: Sequence[Item]) -> None:
        self.stored[stream] += items

    def piece(self, stream: str, hour: Hour, one: Piece, hashes: Sequence[tuple[str, str]]) -> None:
        batch = one.table.combine_chunks().to_batches()[0]
        self.pieces[stream].append((hour, one._replace(table=batch), hashes))

    def flush(self, before: Hour | None) -> None:
        """Nothing waits."""


class Topics(dict[str, str]):
    def __missing__(self, stream: str) -> str:
        return f"dt/iort/car7/{stream}"


def imported(path: Path, store: Kept) -> Run:
    """Import everything of a bag."""
    (plan,) = look([path], Choice(), start_us=None)
    run = Run(Topics(), RUN, store, Times(FIRST_US, last_us()), RETENTION_S)
    recording = plan.open(Unread())
    streams = recording.open()
    ways: dict[int, _Way] = {}
    for kind, recorded_ns, raw in recording.raw(streams):
        if id(kind) not in ways:
            ways[id(kind)] = _Way(plan, kind, run, None)  # type: ignore[arg-type]  # nothing is large
            ways[id(kind)].declare(recorded_ns, raw)
        ways[id(kind)].take(recorded_ns, raw)
    recording.close()
    run.end("import drive.bag", {})
    return run


def by_agent(path: Path) -> Samples:
    """What an agent would record of a bag, with its own times."""
    found: Samples = defaultdict(list)

    def emit(stream: str, t_us: int, values: Mapping[str, Any], *, more: bool = False) -> float:
        if isinstance(values, RosMessage):
            found[stream].append((t_us, values.raw))
        return 0.0

    config = BagConfig(path=path, topics=tuple(STREAMS.items()), speed=0, stamps="original")
    config.build(ManualClock(now_us=START_NS // 1000)).run(emit, threading.Event())
    return {stream: sorted(some) for stream, some in found.items()}


def of_pieces(store: Kept) -> Samples:
    found: Samples = defaultdict(list)
    for stream, pieces in store.pieces.items():
        for _, one, _ in pieces:
            times = one.table[names.TIME].cast("int64").to_pylist()
            found[stream] += zip(times, one.table[names.MESSAGE].to_pylist(), strict=True)
    return {stream: sorted(some) for stream, some in found.items()}


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_pieces_hold_what_an_agent_records(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("drive.bag" if kind == "bag" else "drive")
    # Over the edge of an hour.
    written(path, kind, seconds=SECONDS, start_ns=START_NS // 10**9 // 3600 * 3600 * 10**9 + 3_598 * 10**9)
    store = Kept(takes_pieces=True)
    imported(path, store)
    assert of_pieces(store) == by_agent(path)
    for pieces in store.pieces.values():
        assert len({hour for hour, _, _ in pieces}) == 2
        numbers = []
        for hour, one, hashes in pieces:
            ids, rows = runs(one.table[names.BATCH_ID])
            assert ids == [key for key, _ in hashes] == sorted(ids)
            times = one.table[names.TIME].cast("int64").to_pylist()
            for key, first, end in zip(ids, rows, rows[1:], strict=False):
                batch, of_batch = batch_id(key), times[first:end]
                numbers.append(batch.seq)
                assert (batch.boot, batch.t_us) == (RUN, of_batch[0])
                assert of_batch == sorted(of_batch)
                assert len({t_us // 1_000_000 for t_us in of_batch}) == 1
                assert hour.start_us <= of_batch[0] < hour.end_us
                sizes = [len(raw) for raw in one.table[names.MESSAGE].to_pylist()[first:end]]
                assert sum(sizes[:-1]) < MAX_BYTES
        assert sorted(numbers) == list(range(len(numbers)))


def test_items_hold_what_an_agent_records(tmp_path: Path) -> None:
    path = tmp_path / "drive.bag"
    written(path, "bag", seconds=SECONDS)
    store = Kept(takes_pieces=False)
    run = imported(path, store)
    found: Samples = defaultdict(list)
    for stream in STREAMS.values():
        seqs = []
        for item in map(plain, store.stored[stream]):
            batch = decode_batch(item)
            seqs.append(batch.seq)
            assert (batch.boot, batch.previous) == (RUN, ())
            assert int(item[RECEIVED_MS]) == batch.times_us[-1] // 1000
            assert int(item[EXPIRES_S]) == int(item[RECEIVED_MS]) // 1000 + RETENTION_S
            # Numbers alone become columns, as in the agent.
            raws = batch.messages.raw if batch.messages is not None else [b""] * len(batch.times_us)
            found[stream] += zip(batch.times_us, raws, strict=True)
        assert sorted(seqs) == list(range(len(seqs)))
    of_agent = by_agent(path)
    assert {stream: [t_us for t_us, _ in sorted(some)] for stream, some in found.items()} == {
        stream: [t_us for t_us, _ in some] for stream, some in of_agent.items()
    }
    assert sorted(found["scan"]) == of_agent["scan"]
    assert len(store.stored[TYPES_STREAM]) >= 1
    told = [decode_batch(plain(item)) for item in store.stored[ACCOUNT_STREAM]]
    accounts = [
        account({name: column[i] for name, column in batch.columns.items()})
        for batch in told
        for i in range(len(batch.times_us))
    ]
    for one in accounts:
        assert isinstance(one, StreamAccount)
        counts = run.counts[one.stream]
        assert (one.taken, one.stored, one.next_seq, one.ended) == (counts.taken,) * 2 + (
            counts.batches,
            True,
        )


def test_another_import_makes_the_same_batches(tmp_path: Path) -> None:
    path = tmp_path / "drive.bag"
    written(path, "bag", seconds=SECONDS)
    first, second = Kept(takes_pieces=True), Kept(takes_pieces=True)
    imported(path, first)
    imported(path, second)
    for stream, pieces in first.pieces.items():
        assert [hashes for *_, hashes in pieces] == [hashes for *_, hashes in second.pieces[stream]]


def test_times_that_nobody_believes_are_left_out_and_counted(tmp_path: Path) -> None:
    store = Kept(takes_pieces=False)
    run = Run(Topics(), RUN, store, Times(FIRST_US, last_us()), RETENTION_S)
    for t_us in (5, FIRST_US, last_us() + 10**9):
        run.sample("vesc", t_us, {"speed": 1.0})
    run.end("import drive.csv", {})
    assert run.without_time == {"vesc": 2}
    assert run.counts["vesc"].stored == 1
    batch = decode_batch(plain(store.stored[ACCOUNT_STREAM][-1]))
    assert '{"vesc.not_a_time":2}' in batch.columns.get("counts", ())


def kind_of(name: str, definition: str) -> Kind:
    kind = RosType("/x", f"std_msgs/{name}", "ab" * 16, definition)
    return Kind("x", kind, None, stamped=False, large=None)


def taken(messages: Sequence[tuple[Kind, int, bytes]]) -> tuple[Kept, Run]:
    store = Kept(takes_pieces=True)
    run = Run(Topics(), RUN, store, Times(FIRST_US, last_us()), RETENTION_S)
    for kind, t_ns, raw in messages:
        run.message(kind, t_ns, raw)
    run.end("import drive.bag", {})
    return store, run


def test_two_types_of_a_topic_are_numbered_as_recorded() -> None:
    """Wherever the memory has them: another import has them elsewhere."""
    kinds = sorted([kind_of("A", "int32 a"), kind_of("B", "int32 b")], key=id)
    for first, second in (kinds, kinds[::-1]):
        messages = [
            (kind, START_NS // 10**9 * 10**9 + i * 10**8, bytes(4)) for i, kind in enumerate((first, second))
        ]
        (piece,) = taken(messages)[0].pieces["x"]
        assert [batch_id(key).seq for key, _ in piece[2]] == [0, 1]


def test_two_definitions_with_one_hash_are_each_read_by_their_own() -> None:
    kinds = [kind_of("A", "int32 a"), kind_of("A", "float32 b")]
    store, _ = taken([(kind, START_NS, bytes(4)) for kind in kinds])
    ((_, piece, _),) = store.pieces["x"]
    assert set(piece.kinds) == {"a", "b"}


def test_a_topic_whose_clock_stands_still_does_not_wait() -> None:
    kind = kind_of("A", "int32 a")
    many = 4 * MAX_SAMPLES
    store = Kept(takes_pieces=True)
    run = Run(Topics(), RUN, store, Times(FIRST_US, last_us()), RETENTION_S)
    for _ in range(many):
        run.message(kind, START_NS, bytes(4))
    assert sum(len(one.table) for _, one, _ in store.pieces["x"]) == many


def test_messages_without_content_and_with_impossible_times() -> None:
    kind = kind_of("Empty", "")
    store, run = taken([(kind, t_ns, b"") for t_ns in (START_NS, 2**64 - 1, 0, START_NS + 1000)])
    assert of_pieces(store)["x"] == [(START_NS // 1000, b""), (START_NS // 1000 + 1, b"")]
    assert run.without_time == {"x": 2}
