"""The examples of docs/how-to/archive-tools.md count each sample once, all through the archive's life."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from iort_contract.messages.batch import Batch
from iort_contract.topics import RECORD, build_topic
from testkit.dynamodb import TELEMETRY, FakeDynamoDB, item_of
from tests.archived import FakeS3, archive, compact

EXAMPLES = Path(__file__).parents[4] / "docs" / "examples"
DAY_US, HOUR_US, S = 86_400_000_000, 3_600_000_000, 1_000_000
START = 1_700_000_000_000_000 // DAY_US * DAY_US + 22 * HOUR_US


def batches(*, late: bool = False) -> list[Batch]:
    """Four hours around midnight, with a batch across each full hour; ``late`` are some in the first hour."""
    made = []
    for hour in range(4):
        for seq in range(3):
            begin = START + hour * HOUR_US + (seq * S if seq < 2 else HOUR_US - S // 2)
            columns = {"speed": [10.0 * hour + seq, None, 3.0]}
            if hour == 3:
                columns["temp_motor"] = [20.0, 21.0, 22.0]
            made.append(
                Batch("0badcafe", 3 * hour + seq, [begin, begin + S // 4, begin + 3 * S // 4], columns)
            )
    if late:
        made.append(Batch("0badcafe", 99, [START + 60 * S], {"speed": [500.0]}))
    return made


def stored(given: list[Batch]) -> FakeDynamoDB:
    table = FakeDynamoDB()
    for batch in given:
        table.put(TELEMETRY, item_of(batch, build_topic(RECORD, "car7", "vesc")))
    return table


@pytest.fixture(params=["hours", "a day", "while a day is joined", "late"])
def copied(request, tmp_path) -> tuple[Path, list[Batch]]:
    """A copy of the archive, and what it holds."""
    table, bucket = stored(batches()), FakeS3()
    archive(table, bucket)
    hours = dict(bucket.objects)
    if request.param != "hours":
        compact(table, bucket)
    if request.param == "while a day is joined":
        bucket.objects |= hours
    if request.param == "late":
        newer = FakeS3()
        archive(stored(batches(late=True)), newer)
        bucket.objects |= {key: body for key, body in newer.objects.items() if key.endswith("/22.parquet")}
    for key, body in bucket.objects.items():
        file = tmp_path / key
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(body)
    return tmp_path / "archive", batches(late=request.param == "late")


@pytest.mark.parametrize("tool", ["pandas", "polars", "duckdb"])
def test_each_sample_counts_once(copied, tool, capsys):
    folder, given = copied
    days: dict[str, list[float | None]] = {"2023-11-14": [], "2023-11-15": []}
    for batch in given:
        days["2023-11-15" if batch.t_us >= START + 2 * HOUR_US else "2023-11-14"] += batch.columns["speed"]
    expected = []
    for day, values in days.items():
        known = [value for value in values if value is not None]
        expected.append(f"{day} {len(values)} {sum(known) / len(known):.6f}")
    runpy.run_path(str(EXAMPLES / f"archive_{tool}.py"))["main"](str(folder), "car7", "vesc")
    assert capsys.readouterr().out.splitlines() == expected
