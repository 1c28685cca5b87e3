"""Batches of version 1, as agents published them before batches had ids."""

from __future__ import annotations

import json
from typing import Any

from iort_contract.messages.batch import Batch, encode_batch
from iort_contract.tables import BATCH, NONFINITE


def old_envelope(batch: Batch, **changes: Any) -> dict[str, Any]:
    """The batch as a changed message of version 1. The form of the samples has not changed since."""
    envelope = json.loads(encode_batch(batch))
    del envelope[BATCH]
    head = {"v": 1, "boot": batch.boot, "seq": batch.seq, "t": batch.t_us}
    return {**envelope, **head, NONFINITE: envelope.get(NONFINITE, 0), **changes}


def old_message(batch: Batch, **changes: Any) -> bytes:
    return json.dumps(old_envelope(batch, **changes), separators=(",", ":")).encode()
