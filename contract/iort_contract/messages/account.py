"""The agent's account of its record: a stream of samples that an audit compares with the table.

Regularly and at its end, a run reports the samples taken and stored for every stream, configured or seen, and
the losses of every source by cause.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Mapping, NamedTuple, Union

from iort_contract.checks import COMPACT, json_text
from iort_contract.limits import ContractError, Value
from iort_contract.messages.envelope import read

# The interval of reports while nothing is lost. Batches are numbered, so a long interval is enough.
ACCOUNT_EVERY_S = 30.0
# The size limit of a text in a sample.
_MAX_TEXT = 4096


@dataclass(frozen=True)
class StreamAccount:
    """A stream's counts since the start of the run: samples ``taken``; samples ``stored`` in batches with
    sequence numbers from ``first_seq`` (inclusive) to ``next_seq`` (exclusive); ``refused`` samples, which no
    message can hold; and ``nulled`` values, which were not finite. The rest of the taken samples was in open
    batches. ``ended`` marks the end of an orderly run, without open batches. ``durable``: whether the queue
    survives the end of the process; None from an older agent. ``replayed``: the samples' times passed faster
    or slower than the clock, so they do not tell how late a batch is."""

    stream: str
    taken: int
    stored: int
    refused: int
    nulled: int
    first_seq: int
    next_seq: int
    ended: bool
    durable: bool | None = None
    replayed: bool = False

    def sample(self) -> dict[str, Value]:
        """The account as a sample."""
        return dict(vars(self))


class SourceAccount(NamedTuple):
    """A source's or the queue's event counts, by a path such as ``/tf.malformed``."""

    source: str
    counts: Mapping[str, int]

    def sample(self) -> dict[str, Value]:
        """The account as a sample; causes that do not fit are added up."""
        counts = dict(sorted(self.counts.items(), key=lambda count: -count[1]))
        rest = 0
        while len(text := COMPACT.encode({**counts, **({"others": rest} if rest else {})})) > _MAX_TEXT:
            rest += counts.pop(next(reversed(list(counts))))
        return {"source": self.source[:_MAX_TEXT], "counts": text}


Account = Union[StreamAccount, SourceAccount]

# Path parts that count messages or rows which were received and not recorded.
LOST = frozenset(
    {
        "malformed",
        "refused",
        "empty",
        "interruptions",
        "dropped_samples",
        "damaged_files",
        "bad_crc",
        "full",
        "disk",
        "left_out",
        "skipped",
        "unread",
        "bad_cells",
        "type_unknown",
        "lost_by_middleware",
        "incompatible_qos",
        "refused_by_middleware",
        "type_not_installed",
        "not_a_number",
        "others",
    }
)


def account(sample: Mapping[str, Value]) -> Account:
    """Decode an account; raises `ContractError` if it is neither kind."""
    if isinstance(sample.get("source"), str):
        try:
            counts = json.loads(json_text(str(sample["counts"]), "counts"))
            return SourceAccount(str(sample["source"]), {str(name): int(n) for name, n in counts.items()})
        except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
            raise ContractError(f"a source's account cannot be decoded: {error}") from error
    return read(StreamAccount, {name: value for name, value in sample.items() if value is not None})


def lost(counts: Mapping[str, int]) -> dict[str, int]:
    """A source's counts of unrecorded messages."""
    parts = {path: path.split(".") for path in counts}
    return {path: counts[path] for path, of in parts.items() if counts[path] and not LOST.isdisjoint(of)}
