"""Keeps the tables of this process' ministack in a ledger."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ministack.services import dynamodb

from local.persistence import streams
from local.persistence.ledger import Ledger, Sync

ACCOUNT, REGION = "000000000000", "eu-west-1"


@contextmanager
def kept(path: Path, sync: Sync = "normal") -> Iterator[streams.Streams]:
    """Keep them in this file; afterwards ministack is as before."""
    before = dict(vars(dynamodb))
    ledger = Ledger(path, sync=sync)
    try:
        yield streams.install(ledger)
    finally:
        vars(dynamodb).update(before)
        ledger.close()
