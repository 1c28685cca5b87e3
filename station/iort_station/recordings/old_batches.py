"""Converts batches of version 1, which had no id, to this version. The samples stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from iort_contract.checks import check_header, check_version, integer
from iort_contract.dynamodb import plain
from iort_contract.limits import BATCH_VERSION, ContractError
from iort_contract.messages.batch import BatchId
from iort_contract.tables import BATCH, NONFINITE, T_US

OLD_VERSION = 1
_VERSION, _BOOT, _SEQ = "v", "boot", "seq"


def is_old(envelope: Mapping[str, Any]) -> bool:
    """Whether a message, or a stored item, is of version 1."""
    version = envelope.get(_VERSION)
    return not isinstance(version, bool) and bool(version == OLD_VERSION)


def upgraded(envelope: Mapping[str, Any]) -> dict[str, Any]:
    """The message in this version; the samples are not checked.

    Raises `ContractError` for another version, and for a batch that can have no id, as before 1970.
    """
    check_version(envelope, OLD_VERSION)
    t_us, seq, nonfinite = (integer(envelope, name) for name in (T_US, _SEQ, NONFINITE))
    boot = check_header(envelope.get(_BOOT), seq, nonfinite)
    if t_us < 0:
        raise ContractError(f"time must be from 1970 on, got {t_us} us")
    gone = {_BOOT, _SEQ, T_US} | (set() if nonfinite else {NONFINITE})
    rest = {name: value for name, value in envelope.items() if name not in gone}
    return {**rest, _VERSION: BATCH_VERSION, BATCH: str(BatchId(t_us, boot, seq))}


def upgraded_item(item: Mapping[str, Any]) -> dict[str, Any]:
    """As `upgraded`, for an item as DynamoDB has it; the other attributes stay exactly as they are."""
    new = upgraded(plain(item))
    kept = {name: value for name, value in item.items() if name in new}
    return {**kept, _VERSION: {"N": str(new[_VERSION])}, BATCH: {"S": new[BATCH]}}
