"""The dearest batches of bench.dear: which of them are refused, and that any robot could send them."""

from __future__ import annotations

import contract
from bench.dear import cases


def test_what_is_dear_without_bound_is_refused_and_the_rest_is_read():
    refused = []
    for case in cases():
        assert len(case.message) <= contract.MAX_MESSAGE_BYTES
        try:
            contract.decode(case.message)
        except contract.ContractError as error:
            refused.append(str(error))
        else:
            refused.append("")
    assert [reason[:12] for reason in refused] == ["samples hold"] * 3 + [""] * 4
