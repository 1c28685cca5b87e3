"""The audit finds a source's last account, and decides whether its run still goes on."""

from __future__ import annotations

import json

from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import Batch, encode_batch
from iort_station.operations.delivery.accounts import held_against, last_of
from iort_station.operations.delivery.audit import audit

T_US, BOOT = 1_750_000_000_000_000, "0badcafe"
HOUR_US = 3_600_000_000


def told(seq, *samples, t_us=T_US, received_us=T_US):
    columns = {name: [sample[name] for sample in samples] for name in samples[0]}
    batch = Batch(BOOT, seq, [t_us] * len(samples), columns)
    return {**json.loads(encode_batch(batch)), "received_ms": received_us // 1000}


def scan(taken, *, ended=False):
    return StreamAccount("scan", taken, taken, 0, 0, 0, taken // 50, ended=ended).sample()


def stored(count):
    """A stream of n batches with fifty samples each."""
    items = [
        {"batch": f"{T_US + seq:016d}-{BOOT}-{seq}", "n": "50", "received_ms": str(T_US // 1000)}
        for seq in range(count)
    ]
    return audit("scan", items)


def test_the_newest_account_wins_after_the_clock_was_set_back():
    items = [
        told(2, SourceAccount("queue", {"dropped_samples": 50}).sample(), t_us=T_US - HOUR_US),
        told(1, scan(150, ended=True), t_us=T_US - HOUR_US),
        told(0, scan(0), t_us=T_US),
    ]
    found = last_of(items)
    assert found[BOOT].streams["scan"].taken == 150
    assert found[BOOT].not_recorded() == {"queue": {"dropped_samples": 50}}
    assert held_against(stored(3), found, T_US).complete
    (short,) = held_against(stored(2), found, T_US).shortfalls
    assert short.samples == 50


def test_the_clouds_clock_decides_whether_a_run_goes_on():
    for off_us in (0, -24 * HOUR_US, 24 * HOUR_US):
        found = last_of([told(0, scan(100), t_us=T_US + off_us, received_us=T_US)])
        assert held_against(stored(2), found, T_US + 1_000_000).complete
        (short,) = held_against(stored(2), found, T_US + HOUR_US).shortfalls
        assert "did not end properly" in short.cause
