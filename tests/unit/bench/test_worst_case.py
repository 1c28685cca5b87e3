"""The most expensive batches that a robot could send; the contract refuses the unbounded ones."""

from __future__ import annotations

from iort_contract.limits import MAX_BATCH_VALUES, MAX_MESSAGE_BYTES, ContractError
from iort_contract.messages.batch import decode_batch
from testkit.worst_case import cases, worst_batches


def test_only_unbounded_batches_are_refused():
    refused = []
    for case in cases():
        assert len(case.message) <= MAX_MESSAGE_BYTES
        try:
            decode_batch(case.message)
        except ContractError as error:
            refused.append(str(error))
        else:
            refused.append("")
    assert [reason[:12] for reason in refused] == ["samples must"] * 3 + [""] * 4


def test_each_worst_batch_covers_one_second():
    found = [decode_batch(message) for message in worst_batches(3, first_us=5_000_000)]
    assert [(batch.t_us, batch.seq) for batch in found] == [(5_000_000, 0), (6_000_000, 1), (7_000_000, 2)]
    assert {len(batch.times_us) for batch in found} == {MAX_BATCH_VALUES}
