"""Closed batches become messages in the spool; what the contract or the broker would refuse does not."""

from __future__ import annotations

import logging
import math
from typing import Hashable, Mapping, Sequence

from iort_agent.lanes.batch import Sample, StreamCounts
from iort_agent.spool.memory import Spool
from iort_contract.limits import MAX_MESSAGE_BYTES, ContractError, Value
from iort_contract.messages.batch import Batch, encode_batch, split_batch
from iort_contract.ros1.message import Messages, RosMessage

_log = logging.getLogger(__name__)


class Packer:
    """Encodes one stream's batches, halving those that do not fit, down to the sample to refuse."""

    def __init__(self, *, stream: str, boot: str, spool: Spool, counts: StreamCounts) -> None:
        self._stream = stream
        self._boot = boot
        self._spool = spool
        self._counts = counts

    def store(self, samples: list[Sample]) -> None:
        """Encode the samples and put them into the spool, in as many messages as they need: one for each
        ROS type, or each set of fields, since a missing field is not the same as a null one."""
        alike: dict[Hashable, list[Sample]] = {}
        for sample in samples:
            values = sample[1]
            names = values.beside if isinstance(values, RosMessage) else values
            kind = values.kind.id if isinstance(values, RosMessage) else None
            shape = (kind, frozenset(names))
            alike.setdefault(shape, []).append(sample)
        for group in alike.values():
            self._put(_batch(self._boot, group))

    def _put(self, batch: Batch) -> None:
        seq = self._spool.next_seq(self._stream)
        n = len(batch.times_us)
        try:
            payload = encode_batch(Batch(batch.boot, seq, batch.times_us, batch.columns, 0, batch.messages))
        except ContractError as error:
            # One bad value must not cost the others: halve until it stands alone.
            if n == 1:
                self._refuse(str(error))
                return
        else:
            if len(payload) <= MAX_MESSAGE_BYTES:
                self._spool.put(self._stream, seq, payload, samples=n)
                self._counts.batches += 1
                self._counts.stored += n
                self._counts.nulled += _nonfinite(batch.columns)
                return
            if n == 1:
                self._refuse(f"the message would have {len(payload)} of {MAX_MESSAGE_BYTES} bytes")
                return
        for half in split_batch(batch):
            self._put(half)

    def _refuse(self, why: str) -> None:
        self._counts.refused += 1
        # A stream that is wrong is wrong at its full rate; the first one says it all.
        level = logging.WARNING if self._counts.refused == 1 else logging.DEBUG
        _log.log(level, "stream %s: a sample cannot be sent: %s", self._stream, why)


def _batch(boot: str, samples: Sequence[Sample]) -> Batch:
    times = [t_us for t_us, _ in samples]
    first = samples[0][1]
    if isinstance(first, RosMessage):
        messages = [values for _, values in samples if isinstance(values, RosMessage)]
        beside = {name: [message.beside[name] for message in messages] for name in first.beside}
        raw = [message.raw for message in messages]
        return Batch(boot, 0, times, beside, 0, Messages(first.kind.id, first.kind.layout, raw))
    columns = {name: [values[name] for _, values in samples] for name in first}
    return Batch(boot, 0, times, columns)


def _nonfinite(columns: Mapping[str, Sequence[Value]]) -> int:
    return sum(map(_nonfinite_of, columns.values()))


def _nonfinite_of(column: Sequence[Value]) -> int:
    try:
        if all(map(math.isfinite, column)):  # type: ignore[arg-type]  # what is no number is told apart below
            return 0
    except (TypeError, OverflowError):
        pass  # a text, a null, or an integer beyond every float among them
    return sum(type(value) is float and not math.isfinite(value) for value in column)
