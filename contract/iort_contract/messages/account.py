"""What the agent says of its own record: a stream of samples, against which an audit holds the table.

Once in a while and at its end a run says of every stream that it was configured for or has seen how many
samples it took and stored, and of every source what it did not record, by cause.
"""

from __future__ import annotations

import json
from typing import Mapping, NamedTuple, Union

from iort_contract.limits import ContractError, Value

# How often a run tells it while nothing is lost. Batches are numbered, so seldom is enough.
ACCOUNT_EVERY_S = 30.0
# A text in a sample holds no more.
_MAX_TEXT = 4096


class StreamAccount(NamedTuple):
    """Of one stream, since the start of the run: samples ``taken``, ``stored`` in batches whose numbers are
    from ``first_seq`` to before ``next_seq``, ``refused`` because no message can hold them, and values
    ``nulled`` because they were not finite. The rest of those taken were in open batches. ``ended`` says that
    the run ended in good order, so that nothing was."""

    stream: str
    taken: int
    stored: int
    refused: int
    nulled: int
    first_seq: int
    next_seq: int
    ended: bool

    def sample(self) -> dict[str, Value]:
        """The account as a sample."""
        return dict(self._asdict())


class SourceAccount(NamedTuple):
    """Of one source, or of the queue: how often what happened, by a path such as ``/tf.malformed``."""

    source: str
    counts: Mapping[str, int]

    def sample(self) -> dict[str, Value]:
        """The account as a sample; causes that do not fit are counted together."""
        counts = dict(sorted(self.counts.items(), key=lambda count: -count[1]))
        rest = 0
        while len(text := _json({**counts, **({"others": rest} if rest else {})})) > _MAX_TEXT:
            rest += counts.pop(next(reversed(list(counts))))
        return {"source": self.source[:_MAX_TEXT], "counts": text}


Account = Union[StreamAccount, SourceAccount]

# Parts of paths that count messages or rows that were given and are not in the record.
LOST = frozenset(
    {
        "malformed",
        "refused",
        "empty",
        "missed",
        "interruptions",
        "dropped_samples",
        "bad_crc",
        "full",
        "disk",
        "left_out",
        "skipped",
        "bad_cells",
        "structure_not_kept",
        "not_a_number",
        "others",
    }
)


def account(sample: Mapping[str, Value]) -> Account:
    """The account in a sample; raises `ContractError` for what neither kind can have written."""
    if isinstance(sample.get("source"), str):
        try:
            counts = json.loads(str(sample["counts"]))
            return SourceAccount(str(sample["source"]), {str(name): int(n) for name, n in counts.items()})
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise ContractError(f"a source's account that cannot be read: {error}") from error
    try:
        names = StreamAccount._fields[1:-1]
        taken, stored, refused, nulled, first_seq, next_seq = (int(sample[name] or 0) for name in names)
        return StreamAccount(
            str(sample["stream"]), taken, stored, refused, nulled, first_seq, next_seq, bool(sample["ended"])
        )
    except (KeyError, ValueError, TypeError) as error:
        raise ContractError(f"a stream's account that cannot be read: {error}") from error


def lost(counts: Mapping[str, int]) -> dict[str, int]:
    """Those of a source's counts that stand for what is not in the record."""
    parts = {path: path.split(".") for path in counts}
    return {path: counts[path] for path, of in parts.items() if counts[path] and not LOST.isdisjoint(of)}


def _json(counts: Mapping[str, int]) -> str:
    return json.dumps(counts, separators=(",", ":"))
