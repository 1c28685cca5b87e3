"""One sample's walk from the ROS callback to the history chart, as the architecture page lists it."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from iort_agent.clock import SystemClock
from iort_agent.lanes.batch_encoder import BatchEncoder
from iort_agent.lanes.record import RecordLane
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.sources.intake import Intake, TopicConfig
from iort_agent.spool.config import QueueConfig
from iort_agent.spool.sqlite import make_spool
from iort_contract.tables import RECEIVED_MS
from iort_station.page.answers.history import history
from tests.fakes import TELEMETRY, item_of_message, record_of
from tests.ros1_types import Message, header
from tests.unit.functions.summary.summarizing import Stream
from tests.unit.station.data.test_data import cloud_of

ROOT = Path(__file__).resolve().parents[3]
FOLDERS = ("contract", "device", "analysis", "functions", "station")
SPEED = Message("a_msgs/Speed", {"a_msgs/Speed": "Header header\nfloat64 speed"})
CONNECTION = {
    "callerid": "/maker",
    "type": SPEED.kind,
    "md5sum": SPEED.md5sum,
    "message_definition": SPEED.definition,
}


class Uplink:
    """An uplink that accepts every publish."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes]] = []
        self.taken = threading.Event()

    def connected(self) -> bool:
        return True

    def on_connection(self, _handler: Any) -> None:
        pass

    def publish(self, topic: str, payload: bytes, *, qos: int, done: Callable[[None], None]) -> None:
        self.published.append((topic, payload))
        done(None)
        self.taken.set()


@contextmanager
def watched(walked: set[str], *, here: bool = True) -> Iterator[None]:
    """Record our modules in which a function runs, in new threads and, if ``here``, in this one."""
    files = set()

    def note(frame: FrameType, event: str, _argument: Any) -> None:
        if event == "call":
            files.add(frame.f_code.co_filename)

    threading.setprofile(note)
    if here:
        sys.setprofile(note)
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    inside = (Path(file).relative_to(ROOT) for file in files if Path(file).is_relative_to(ROOT))
    walked |= {file.as_posix() for file in inside if file.parts[0] in FOLDERS}


def send(folder: Path, t_us: int, walked: set[str]) -> bytes:
    """The batch that a robot publishes for one ROS message; the set-up of the agent is not on the walk."""
    clock, uplink, stop = SystemClock(), Uplink(), threading.Event()
    spool = make_spool(QueueConfig(path=folder / "queue.db"), clock)
    lane = RecordLane(
        robot="car",
        namespace="iort",
        spool=spool,
        uplink=uplink,
        clock=clock,
        rate_limiter=RateLimiter(clock),
    )
    encoder = BatchEncoder("speed", boot="0badcafe0badcafe", batch_s=1, spool=spool, clock=clock)

    def emit(stream: str, at_us: int, values: Any) -> None:
        # The message's type is published as its own sample.
        if stream == "speed":
            encoder.add(at_us, values)

    sending = threading.Thread(target=lane.run, args=(stop,))
    sending.start()
    intake = Intake("/speed", TopicConfig(stream="speed", time="header"), emit=emit, clock=clock)
    with watched(walked):
        intake.take(CONNECTION, header(1, t_us, b"car") + bytes(8))
        encoder.flush()
    taken = uplink.taken.wait(30)
    stop.set()
    lane.wake()
    sending.join()
    spool.close()
    assert taken
    ((_, payload),) = uplink.published
    return payload


def test_the_walk_passes_the_documented_modules(tmp_path: Path) -> None:
    to_chart: set[str] = set()
    to_summary: set[str] = set()
    t_us, cloud = SystemClock().now_us(), cloud_of()
    with watched(to_chart, here=False):
        payload = send(tmp_path, t_us, to_chart)
    item = item_of_message(payload, "dt/iort/car/speed")
    item[RECEIVED_MS] = {"N": str(t_us // 1000)}
    cloud.table.put(TELEMETRY, item)
    lambda_2 = Stream(cloud.table)
    asked = {"robot": "car", "stream": "speed", "from_us": str(t_us), "to_us": str(t_us + 1), "rows": "9"}
    with watched(to_summary):
        lambda_2.summarize([record_of(item)])
    with watched(to_chart):
        chart = history(cloud, asked)
    assert chart["fields"] == {"speed": {"mean": [0.0]}}
    assert len(lambda_2.summary("dt/iort/car/speed")) == 1
    page = (ROOT / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    (walk,) = re.findall(r"^## One sample's walk\n(.+?)^## ", page, re.DOTALL | re.MULTILINE)
    aside, way = set(), set()
    for row in walk.splitlines():
        if row.startswith("|"):
            (aside if row.startswith("| Lambda 2") else way).update(re.findall(r"`(\S+\.py)`", row))
    assert way == to_chart
    assert aside == to_summary - to_chart
    assert f"passes {len(way)} Python modules" in walk
    assert f"{len(aside)} more" in walk
