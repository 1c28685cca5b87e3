"""The runs of a robot's agent, found without reading what they recorded.

The key of a batch has its time, its run and its number within the run. A batch spans at most a second, so the
number tells how far back the run may have begun; the batch before its first one is the last of another run.
A run of a stream thus costs some four reads of one batch, however long it is. Runs that recorded the same
stream at the same time may look shorter than they are.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from typing import NamedTuple

from iort_analysis.archive.stored import Origin
from iort_analysis.samples.batches import ATTRIBUTES
from iort_contract.catalog.streams import ACCOUNT_STREAM, OWN_STREAMS
from iort_contract.dynamodb import plain, starting_between, whole
from iort_contract.limits import MAX_BATCH_SPAN_US, ContractError
from iort_contract.messages.account import ACCOUNT_EVERY_S, StreamAccount, account, lost
from iort_contract.messages.analysis.insights import Extent
from iort_contract.messages.batch import BatchId, decode_batch
from iort_contract.messages.page import Run, RunPart, RunsAnswer, RunState
from iort_contract.tables import RECEIVED_MS
from iort_station.cloud import Cloud
from iort_station.data import inventory
from iort_station.data.stored.recorded import Recorded

# A run that has been silent for this long has ended.
_SILENT_US = round(4e6 * ACCOUNT_EVERY_S)
_READERS = 8


class Part(NamedTuple):
    """A stream's first and last batch of a run, or of all runs; and the time just after the last sample."""

    first: BatchId
    last: BatchId
    to_us: int

    @property
    def extent(self) -> Extent:
        return {"from_us": self.first.t_us, "to_us": self.to_us}


class _Account(NamedTuple):
    """The last report of a run: its streams, what it did not record, and when the cloud received it."""

    part: Part
    streams: dict[str, StreamAccount]
    lost: int
    received_us: int

    @property
    def state(self) -> RunState:
        """How the run went on."""
        if any(one.ended for one in self.streams.values()):
            return "ended"
        return "running" if time.time() * 1e6 - self.received_us < _SILENT_US else "cut off"


def runs(
    cloud: Cloud,
    robot: str,
    *,
    streams: Sequence[str] | None = None,
    start_us: int | None = None,
    end_us: int | None = None,
    count: int = 50,
    origin: Origin | None = None,
) -> RunsAnswer:
    """The newest ``count`` runs of a robot that recorded in a range, with the extent of its streams.

    ``origin`` learns which hours of the archive were read.

    ``streams`` None means all but the agent's own. A run that began before the range is given whole, and one
    that goes on after its end up to there. Raises `StationError` for an unknown robot.
    """
    if streams is None:
        streams = [name for name in inventory.check_recorded(cloud, robot) if name not in OWN_STREAMS]
    recorded = (Recorded(cloud, robot, name, origin=origin) for name in (ACCOUNT_STREAM, *streams))
    reports, *readers = map(_Reader, recorded)

    def parts(reader: _Reader) -> list[Part]:
        return list(islice(reader.parts(start_us, end_us), count + 1))

    with ThreadPoolExecutor(_READERS) as pool:
        wholes = pool.map(_Reader.whole, readers)
        reported, *found = pool.map(parts, [reports, *readers])
        accounts = {one.part.last.boot: one for one in pool.map(reports.account, reversed(reported))}
    extents = {stream: whole.extent for stream, whole in zip(streams, wholes, strict=True) if whole}
    made = _by_run(dict(zip(streams, found, strict=True)), accounts)
    made.sort(key=lambda run: run["to_us"], reverse=True)
    goes_on = None if end_us is None else reports.boot_from(end_us)
    for i, run in enumerate(made):
        if run["run"] == goes_on:
            # The report of its end is not read.
            run["state"] = "unknown"
        elif i and run["state"] == "running":
            run["state"] = "cut off"
    return {"runs": made[:count], "older": len(made) > count, "streams": extents}


def _by_run(found: dict[str, list[Part]], accounts: dict[str, _Account]) -> list[Run]:
    """The runs with what each recorded of every stream, in no order."""
    made: dict[str, Run] = {}
    for boot, one in accounts.items():
        # A run with samples is shown for its samples' times, which may be those of a recording.
        if not any(stream.stored for stream in one.streams.values()):
            made[boot] = _run(boot, one.part, one)
    for stream, parts in found.items():
        for part in parts:
            boot = part.last.boot
            run = made.setdefault(boot, _run(boot, part, accounts.get(boot)))
            _widen(run, part)
            run["streams"].setdefault(stream, _run_part(stream, part, accounts.get(boot)))
    return list(made.values())


def _run(boot: str, part: Part, reported: _Account | None) -> Run:
    young = time.time() * 1e6 - part.to_us < _SILENT_US
    return {
        **part.extent,
        "run": boot,
        "state": ("running" if young else "unknown") if reported is None else reported.state,
        "lost": 0 if reported is None else reported.lost,
        "streams": {},
    }


def _run_part(stream: str, part: Part, reported: _Account | None) -> RunPart:
    counted = None if reported is None else reported.streams.get(stream)
    return {
        **part.extent,
        "batches": part.last.seq - part.first.seq + 1,
        "samples": None if counted is None else counted.stored,
    }


def _widen(extent: Extent, part: Part) -> None:
    extent["from_us"] = min(extent["from_us"], part.first.t_us)
    extent["to_us"] = max(extent["to_us"], part.to_us)


class _Reader:
    """Reads single batches of a stream."""

    def __init__(self, recorded: Recorded) -> None:
        self._recorded = recorded

    def whole(self) -> Part | None:
        """All that is stored of the stream; None if nothing is."""
        first, last = self._recorded.after(None), self._recorded.before(None)
        return None if first is None or last is None else Part(first, last, self._end_us(last))

    def parts(self, start_us: int | None, end_us: int | None) -> Iterator[Part]:
        """What each run recorded in a range, newest first; the first one may begin before the range."""
        last = self._recorded.before(end_us)
        while last is not None and (start_us is None or last.t_us + MAX_BATCH_SPAN_US > start_us):
            first, before = self._first_of(last)
            yield Part(first, last, self._end_us(last))
            last = before

    def boot_from(self, t_us: int) -> str | None:
        """The run of the first batch from a time on."""
        found = self._recorded.after(t_us)
        return None if found is None else found.boot

    def account(self, part: Part) -> _Account:
        """The last report of a run."""
        streams: dict[str, StreamAccount] = {}
        losses: dict[str, int] = {}
        received_us = 0
        # An agent that does not batch sends a report in several messages.
        keys = starting_between(part.last.t_us - MAX_BATCH_SPAN_US, part.last.t_us)
        for items in self._recorded.items(keys, (*ATTRIBUTES, RECEIVED_MS)):
            for item in items:
                with suppress(ContractError):
                    batch = decode_batch(plain(item))
                    if batch.boot != part.last.boot:
                        continue
                    received_us = (whole(item, RECEIVED_MS) or 0) * 1000
                    for i in range(len(batch.times_us)):
                        one = account({name: column[i] for name, column in batch.columns.items()})
                        if isinstance(one, StreamAccount):
                            streams[one.stream] = one
                        else:
                            losses[one.source] = sum(lost(one.counts).values())
        refused = sum(one.refused for one in streams.values())
        return _Account(part, streams, refused + sum(losses.values()), received_us)

    def _first_of(self, last: BatchId) -> tuple[BatchId, BatchId | None]:
        """The first batch of the run of ``last``, and the one before it, of another run."""
        known, other_us = last, None
        jump_us = (last.seq + 1) * MAX_BATCH_SPAN_US
        while other_us is None or known.t_us - other_us > 1:
            if other_us is None:
                at_us, jump_us = known.t_us - jump_us, 2 * jump_us
            else:
                at_us = (other_us + known.t_us + 1) // 2
            found = self._recorded.after(max(0, at_us)) or known
            if found.boot != last.boot:
                other_us = found.t_us
                continue
            before = self._recorded.before(found.t_us)
            if before is None or before.boot != last.boot:
                return found, before
            known = before
        return known, self._recorded.before(known.t_us)

    def _end_us(self, last: BatchId) -> int:
        times_us = self._recorded.block(last, lambda _name: False).times_us
        return int(times_us[-1] if len(times_us) else last.t_us) + 1
