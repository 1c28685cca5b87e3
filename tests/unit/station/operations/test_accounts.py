"""The audit finds a source's last account, and decides whether its run still goes on."""

from __future__ import annotations

import json

import pytest

from iort_contract.messages.account import SourceAccount, StreamAccount
from iort_contract.messages.batch import Batch, encode_batch
from iort_station.data.accounts import last_of
from iort_station.operations.audit import audit, held_against, in_car, without_lateness

T_US, BOOT = 1_750_000_000_000_000, "0badcafe"
HOUR_US = 3_600_000_000


def told(seq, *samples, t_us=T_US, received_us=T_US):
    columns = {name: [sample[name] for sample in samples] for name in samples[0]}
    batch = Batch(BOOT, seq, [t_us] * len(samples), columns)
    return {**json.loads(encode_batch(batch)), "received_ms": received_us // 1000}


def scan(taken, *, ended=False, **more):
    return StreamAccount("scan", taken, taken, 0, 0, 0, taken // 50, ended=ended, **more).sample()


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


@pytest.mark.parametrize(
    ("durable", "cause"),
    [
        (True, "at most one second: the run"),
        (False, "at most one second, or waited in the queue, which was in memory: the run"),
        (None, "at most one second, or in the queue if it was in memory: the run"),
    ],
)
def test_a_killed_run_has_lost_what_its_own_queue_could_not_keep(durable, cause):
    sample = {name: value for name, value in scan(100, durable=durable).items() if value is not None}
    (short,) = held_against(stored(2), last_of([told(0, sample)]), T_US + HOUR_US).shortfalls
    assert cause in short.cause


def test_a_recording_at_another_speed_does_not_tell_how_late_it_is():
    def at(seq, *, late_ms):
        return {
            "batch": f"{T_US + seq:016d}-{BOOT}-{seq}",
            "n": "50",
            "received_ms": str(T_US // 1000 + late_ms),
        }

    late = audit("scan", [at(0, late_ms=0), at(1, late_ms=9000)])
    assert late.runs[0].late == 1
    assert without_lateness(late, last_of([told(0, scan(100))])).runs[0].late == 1
    played = without_lateness(late, last_of([told(0, scan(100, replayed=True))]))
    assert (played.runs[0].late, played.runs[0].latest_ms) == (None, None)
    assert without_lateness(late, {}) == late


def test_after_a_run_that_ended_in_good_order_nothing_is_in_the_car():
    ended, running = (last_of([told(0, scan(100, ended=ended))]) for ended in (True, False))
    whole = [held_against(stored(2), ended, T_US)]
    assert [in_car(last, whole, ended) for last in (21, 0, None)] == [0, 0, None]
    assert in_car(21, whole, running) == 21
    assert in_car(21, [held_against(stored(1), ended, T_US)], ended) == 21, "batches are missing"
