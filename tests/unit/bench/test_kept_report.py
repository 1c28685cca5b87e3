"""The report of the soak."""

from __future__ import annotations

import pytest

from bench.keeping import report
from bench.keeping.counted import Counted
from bench.keeping.soak import Look
from bench.keeping.week import Soak
from testkit import machine
from tests.unit.bench.test_kills import DRIVE


def soak(*emulator_mb: float) -> Soak:
    looks = [Look(hour + 1, 300, 10.0 * hour, mb, 700.0, 5.0, 1.0) for hour, mb in enumerate(emulator_mb)]
    car = Counted(15_000, 300, 0, 0, (), 0, 15_000, 15_000)
    return Soak(len(looks), 1, looks, {"car1": 15_000}, {"car1": car})


@pytest.mark.parametrize(("last", "good"), [(101.0, True), (111.0, False)])
def test_memory_may_not_grow_after_the_first_quarter(last, good):
    assert soak(80.0, 100.0, 100.0, last).good is good


def test_a_part_that_was_not_measured_now_stays_in_the_report(tmp_path):
    folder, here = tmp_path / "new", machine.describe()
    report.write(folder, None, soak(100.0, 100.0, 100.0, 101.0), here)
    report.write(folder, DRIVE, None, here)

    text = (folder / "kept.md").read_text()
    assert "0 lost, memory +1.0% from the second quarter to the last" in text
    assert DRIVE.table().as_markdown() in text
    assert (folder / "kept.svg").exists()
