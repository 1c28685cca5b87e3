"""The dearest batches of bench.dear: which of them are refused, and that any robot could send them."""

from __future__ import annotations

import iort_contract
from bench.dear import cases, dearest


def test_what_is_dear_without_bound_is_refused_and_the_rest_is_read():
    refused = []
    for case in cases():
        assert len(case.message) <= iort_contract.MAX_MESSAGE_BYTES
        try:
            iort_contract.decode(case.message)
        except iort_contract.ContractError as error:
            refused.append(str(error))
        else:
            refused.append("")
    assert [reason[:12] for reason in refused] == ["samples hold"] * 3 + [""] * 4


def test_as_many_of_the_dearest_as_are_wanted_are_of_a_second_each():
    found = [iort_contract.decode(message) for message in dearest(3, first_us=5_000_000)]
    assert [(batch.t_us, batch.seq) for batch in found] == [(5_000_000, 0), (6_000_000, 1), (7_000_000, 2)]
    assert {len(batch.times_us) for batch in found} == {iort_contract.MAX_BATCH_VALUES}
