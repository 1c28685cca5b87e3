"""Damaged items among good ones, through every reader: each is passed over and counted, and of the others
nothing is lost. IORT_MUTATED is the number of damaged items: `IORT_MUTATED=60000 pytest FILE -m slow`."""

from __future__ import annotations

import os
from pathlib import Path
from random import Random
from typing import Any

import pytest

from functions.analyse import analysed
from functions.plan import planned
from functions.query import answer
from functions.shared.recordings import Recordings
from functions.shared.summary import recompute
from iort_analysis.archive.hours import Stores
from iort_analysis.samples.batches import RefusedItems
from iort_contract.archive import ArchiveTable
from iort_contract.dynamodb import TelemetryTable, plain
from iort_contract.limits import ContractError
from iort_contract.messages.analysis import AnalysisRequest
from iort_contract.messages.batch import Batch, decode_batch
from iort_contract.tables import BATCH, RECOMPUTE_FROM_S, TOPIC
from iort_station import data
from iort_station.operations import audit
from iort_station.page.answers import answers
from iort_station.page.history import downloads
from testkit.dynamodb import ARCHIVE, ROBOTS, TELEMETRY, item_of
from tests.archived import FakeS3, archive, expire
from tests.mutation import ODD_ATTRIBUTES, mutated_item
from tests.unit.functions.summarizing import Stream
from tests.unit.station.data.test_queries import FakeCloud, cloud_of

COUNT = int(os.environ.get("IORT_MUTATED", "600"))
S = 1_000_000
START = 1_700_000_000 * S
# The items of a table; one in four is good.
ITEMS = 400
KEYS = frozenset({TOPIC, BATCH})
ODD_KEYS = ("~", "", "x", "\ud7ff", f"{START}-0badcafe", f"{START + 5}-0BADCAFE-1")


def stored(random: Random) -> tuple[list[dict[str, Any]], list[int], int]:
    """The items, the times of the good ones' samples, and how many items are no batches."""
    items, times = {}, []
    for seq in range(ITEMS):
        at = [START + seq * S + i * 200_000 for i in range(5)]
        columns = {
            "speed": [1000 + seq % 50 + i / 4 for i in range(5)],
            "voltage_input": [12, 12.5, 12, 11, 12],
        }
        item = item_of(Batch("0badcafe", seq, at, columns | ({"mode": ["a"] * 5} if seq % 9 == 0 else {})))
        if seq % 4 == 0:
            times += at
        else:
            item = mutated_item(random, item, KEYS, ODD_ATTRIBUTES)
            if random.random() < 0.03:
                item[BATCH] = {"S": random.choice(ODD_KEYS)}
        items[item[TOPIC]["S"], item[BATCH]["S"]] = item
    # A key that begins with no time is in no range.
    timed = [item for item in items.values() if item[BATCH]["S"][:1].isdigit()]
    return list(items.values()), times, sum(map(is_refused, timed))


def is_refused(item: dict[str, Any]) -> bool:
    try:
        decode_batch(plain(item))
    except ContractError:
        return True
    return False


def recordings(cloud: FakeCloud) -> Recordings:
    table = cloud.table
    tables = TelemetryTable(table, TELEMETRY), ArchiveTable(table, ARCHIVE)
    return Recordings(
        table, Stores(*tables, lambda: (cloud.bucket, "files")), robots=ROBOTS, namespace="iort"
    )


def check(cloud: FakeCloud, times: list[int], refused: int, folder: Path) -> None:
    """Read by every reader."""
    good, (first, last) = set(times), (START - S, START + 2 * ITEMS * S)
    found = data.query(cloud, "car", "vesc")
    assert good <= set(found.times_us.tolist())
    assert found.refused == refused
    assert "dt/iort/car/vesc at" in found.reason
    asked = {"robot": "car", "stream": "vesc", "from_us": str(first), "to_us": str(last), "rows": "5000"}
    history = answers(cloud)["history"](asked)
    assert good <= {round(at * 1e6) for at in history["times_s"]}
    assert 0 < history["refused"] <= refused
    assert answers(cloud)["runs"]({"robot": "car", "count": "9"})["runs"]
    for name in ("history.mcap", "history.csv"):
        downloads(cloud)[name](asked, folder).unlink()
    named = RefusedItems()
    audited = audit.audit("vesc", audit.headers(cloud, "car", "vesc", refused=named))
    assert audited.refused == named.count >= refused
    assert sum(run.samples for run in audited.runs) >= len(good)
    stores = recordings(cloud)
    drives = planned("car", AnalysisRequest(("car",), START, last), stores)
    results = [analysed(drive, stores) for drive in drives]
    assert sum(result.samples for result in results) >= len(good)
    assert any("cannot be decoded" in text for one in results for text in one.mined.missing.values())
    assert len(data.query(cloud, "car", "vesc", summary=True))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(-(-COUNT // (ITEMS * 3 // 4))))
def test_every_reader_passes_over_damaged_items(seed: int, tmp_path: Path) -> None:
    items, times, refused = stored(Random(seed))
    cloud = cloud_of(page_items=150)
    cloud.bucket = FakeS3()
    lambda_2 = Stream(cloud.table)
    recompute({"Records": list(map(lambda_2.store_item, items)), RECOMPUTE_FROM_S: 0}, lambda_2.tables)
    assert len(cloud.table.items[TELEMETRY]) == len(items)
    check(cloud, times, refused, tmp_path)
    request = {"robot": "car", "stream": "vesc"}
    of_function = answer(request, lambda_2.tables, lambda _: "", lambda: 60_000, namespace="iort")
    assert of_function["refused"] == refused
    # The archive passes over a key that begins with no time.
    for key in [key for key in cloud.table.items[TELEMETRY] if not key[1][:1].isdigit()]:
        del cloud.table.items[TELEMETRY][key]
    archive(cloud.table, cloud.bucket)
    expire(cloud.table, every=lambda number: number % 2 == 0)
    check(cloud, times, refused, tmp_path)
    expire(cloud.table)
    check(cloud, times, refused, tmp_path)
