"""A week of five cars on a kept cloud, on a clock that is set forward while nothing is under way.

In each hour of the clock every car drives so many minutes at 50 Hz, a batch a second, as fast as the broker
acknowledges. When everything is summarised the clock is set to the next hour: records of streams, sessions,
metrics and items expire and the archive takes its hours by that clock. The soak is a process with its own
clock, this module again, which writes a JSON object a line.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from bench import plots
from bench.load.generator import Columns, Load, Robot, laps
from bench.report import KEPT, Section
from bench.sections import Declared, Option
from bench.sections.kept import Counted, count
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.tables import SECOND
from iort_station.cloud import Cloud
from iort_station.data.recorded import summary_table, topic_of
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from testkit import ROOT, machine
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

_FILE, _PRELOAD = "BENCH_CLOCK", "LD_PRELOAD"


class Clock:
    """The clock of this process, which has an `environment`, and of all below it."""

    def __init__(self) -> None:
        self._path = Path(os.environ[_FILE])
        self._offset_s = 0

    def forward(self, seconds: int) -> None:
        """Set the clock forward for every process."""
        self._offset_s += seconds
        # They have it mapped: it must stay the same file.
        with self._path.open("r+b") as file:
            file.write(struct.pack("=q", self._offset_s))


def environment(folder: Path) -> dict[str, str]:
    """The environment of a process with a clock of its own. Raises `InstrumentError` without a C compiler."""
    compiler, library, file = shutil.which("cc"), folder / "clock.so", folder / "clock"
    if compiler is None:
        raise InstrumentError(
            "there is no C compiler, which makes the soak's clock: apt install gcc libc6-dev"
        )
    source = Path(__file__).with_name("clock.c")
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl"], check=True)
    file.write_bytes(struct.pack("=q", 0))
    return {_PRELOAD: str(library), _FILE: str(file)}


def inherited() -> dict[str, str]:
    """The part of this process' environment that `environment` made."""
    return {name: os.environ[name] for name in (_PRELOAD, _FILE)}


CARS, RATE_HZ = 5, 50
_HOUR_S = 3_600
# Batches of a car that wait for their acknowledgement.
_WINDOW = 20
_CONNECT_S, _SUMMARY_S, _IDLE_S = 60.0, 180.0, 600.0
_QUIET_S = 0.5


@dataclass(frozen=True)
class Look:
    """What the cloud takes after so many hours of the clock; memory without what processes share."""

    hour: int
    batches: int
    seconds: float
    emulator_mb: float
    functions_mb: float
    ledger_mb: float
    files_mb: float


class Car(Robot):
    """A car that waits for acknowledgements when too many are missing."""

    last_s = 0

    def drive(self, first_s: int, seconds: int) -> None:
        """Send the batches of these seconds, and wait until all are acknowledged."""
        for self.last_s in range(first_s, first_s + seconds):
            self.send(self.last_s * 1_000_000)
            self._wait(_WINDOW)
        self._wait(0)

    def _wait(self, most: int) -> None:
        pause, deadline = threading.Event(), time.monotonic() + _CONNECT_S
        while len(self.sent_ms) - len(self.acknowledged) > most:
            if time.monotonic() > deadline:
                raise InstrumentError(f"{self.name}: no acknowledgement in {_CONNECT_S:.0f} s")
            pause.wait(0.005)


def soak(folder: Path, hours: int, minutes: int) -> None:
    """Drive through the hours; say how it goes, and at the end what is stored."""
    clock = Clock()
    with EmbeddedCloud(
        folder / "cloud", kept=True, any_ports=True, live="iot", environment=inherited()
    ) as embedded:
        cars = _cars(embedded.cloud, folder)
        began = time.monotonic()
        for hour in range(hours):
            _hour(cars, minutes * 60)
            _summarized(embedded.cloud, cars)
            _wait_until_idle(embedded)
            _say(look=asdict(_look(embedded, hour + 1, sum(len(car.sent_ms) for car in cars), began)))
            clock.forward(_HOUR_S - int(time.time()) % _HOUR_S)
        for car in cars:
            car.client.stop()
        found = {car.name: asdict(count(embedded.cloud, car.name)) for car in cars}
        _say(found=found, sent={car.name: len(car.sent_ms) * RATE_HZ for car in cars})


def _cars(cloud: Cloud, folder: Path) -> list[Car]:
    names = [f"car{i + 1}" for i in range(CARS)]
    bundles = {name: str(robots.add(cloud, name, out=folder / "cars").folder) for name in names}
    load, seconds = (
        Load(bundles, cloud.namespace, cloud.mqtt_endpoint, cloud.mqtt_port, 0, RATE_HZ),
        laps(RATE_HZ),
    )
    cars = [
        Car(name, Path(path), load, _columns(seconds, i)) for i, (name, path) in enumerate(bundles.items())
    ]
    for car in cars:
        car.client.start()
    for car in cars:
        if not car.connected.wait(_CONNECT_S):
            raise InstrumentError(f"{car.name} was not connected within {_CONNECT_S:.0f} s")
    return cars


def _columns(seconds: list[Columns], first: int) -> list[Columns]:
    return seconds[first:] + seconds[:first]


def _hour(cars: list[Car], seconds: int) -> None:
    first_s = int(time.time()) + 1
    driving = [threading.Thread(target=car.drive, args=(first_s, seconds)) for car in cars]
    for thread in driving:
        thread.start()
    for thread in driving:
        thread.join()


def _summarized(cloud: Cloud, cars: list[Car]) -> None:
    """Wait until the newest second of each car is in its summary."""
    table, deadline = summary_table(cloud), time.monotonic() + _SUMMARY_S
    for car in cars:
        topic = topic_of(cloud, car.name, VESC_STREAM)
        while True:
            item = table.first(topic, newest=True, attributes=(SECOND,))
            if item is not None and int(item[SECOND]["N"]) >= car.last_s:
                break
            if time.monotonic() > deadline:
                raise InstrumentError(f"{car.name}: no summary in {_SUMMARY_S:.0f} s")
            threading.Event().wait(0.1)


def _wait_until_idle(embedded: EmbeddedCloud) -> None:
    """Wait until no task of the archive is left and no function works: the clock must not jump meanwhile. A
    task that failed is hidden until its queue gives it out again, by that clock."""
    sqs, emulator = embedded.cloud.client("sqs"), embedded.emulator.pid
    [tasks] = [url for url in sqs.list_queues()["QueueUrls"] if "ArchiveTasks" in url]
    deadline = time.monotonic() + _IDLE_S
    while time.monotonic() < deadline:
        before = machine.usage_below(emulator).cpu_s
        counts = sqs.get_queue_attributes(QueueUrl=tasks, AttributeNames=["All"])["Attributes"]
        threading.Event().wait(_QUIET_S)
        quiet = machine.usage_below(emulator).cpu_s == before
        if quiet and not int(counts["ApproximateNumberOfMessages"]):
            return
    raise InstrumentError(f"the functions still work after {_IDLE_S:.0f} s")


def _look(embedded: EmbeddedCloud, hour: int, batches: int, began: float) -> Look:
    emulator = embedded.emulator.pid
    return Look(
        hour=hour,
        batches=batches,
        seconds=round(time.monotonic() - began, 1),
        emulator_mb=_private_mb(emulator),
        functions_mb=round(sum(map(_private_mb, machine.descendants(emulator))), 1),
        ledger_mb=_disk_mb(embedded.folder.glob("ledger.db*")),
        files_mb=_disk_mb((embedded.folder / "s3").rglob("*")),
    )


def _private_mb(pid: int) -> float:
    """The memory of a process: its own, and its part of what it shares."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return round(sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024, 1)


def _disk_mb(paths: Iterable[Path]) -> float:
    return round(sum(path.stat().st_size for path in paths if path.is_file()) / 2**20, 1)


def _say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


# Growth from the second quarter of the hours to the last: less than measuring varies.
MOST_GROWTH = 0.1


@dataclass(frozen=True)
class Soak:
    """The memory after every hour of the clock, and what the audit found at the end."""

    hours: int
    minutes: int
    looks: Sequence[Look]
    sent: dict[str, int]
    cars: dict[str, Counted]

    @property
    def growth(self) -> float:
        """How much more memory the emulator has in the last quarter than in the second, as a share."""
        quarter = max(1, len(self.looks) // 4)
        early, late = self.looks[quarter : 2 * quarter] or self.looks, self.looks[-quarter:]
        return fmean(one.emulator_mb for one in late) / fmean(one.emulator_mb for one in early) - 1


def in_process(folder: Path, hours: int, minutes: int, say: Callable[[str], None]) -> Soak:
    """Soak in a process of its own; raises `InstrumentError` if it fails."""
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "bench.sections.soak", str(folder)]
    command += ["--hours", str(hours), "--minutes", str(minutes)]
    own = {**os.environ, **environment(folder)}
    looks: list[Look] = []
    end: dict[str, Any] = {}
    say("starting the cloud of the soak")
    with subprocess.Popen(command, cwd=ROOT, env=own, stdout=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stdout or ():
                said = json.loads(line)
                if "look" not in said:
                    end = said
                    continue
                looks.append(Look(**said["look"]))
                say(f"hour {looks[-1].hour} of {hours}: {looks[-1].emulator_mb:.0f} MB")
        except BaseException:
            # Its cloud ends with it.
            process.kill()
            process.wait()
            raise
    if process.returncode or not end:
        raise InstrumentError(f"the soak ended with status {process.returncode}")
    return Soak(
        hours,
        minutes,
        looks,
        end["sent"],
        {
            name: Counted(**{**one, "incomplete": tuple(one["incomplete"])})
            for name, one in end["found"].items()
        },
    )


def run(_target: Target | None, say: Say, *, hours: int, minutes: int) -> Section:
    """Soak for so many hours of the clock."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        return report(in_process(Path(folder) / "soak", hours, minutes, say))


def report(soaked: Soak) -> Section:
    """A row for each of a few hours, the picture, and whether the memory grows."""
    section = Section("soak", f"{soaked.hours} hours of the clock")
    step = max(1, len(soaked.looks) // 8)
    section.table(
        f"{CARS} cars, {soaked.minutes} min at 50 Hz in each of {soaked.hours} hours",
        ["hour", "batches", "emulator MB", "functions MB", "ledger MB", "files MB", "after s"],
        (
            [
                f"{look.hour}",
                f"{look.batches:,}",
                f"{look.emulator_mb:.0f}",
                f"{look.functions_mb:.0f}",
                f"{look.ledger_mb:.0f}",
                f"{look.files_mb:.0f}",
                f"{look.seconds:.0f}",
            ]
            for look in dict.fromkeys([*soaked.looks[::step], soaked.looks[-1]])
        ),
    )
    hours = [look.hour for look in soaked.looks]
    memory = {
        "emulator": [look.emulator_mb for look in soaked.looks],
        "functions": [look.functions_mb for look in soaked.looks],
    }
    draw = plots.over(hours, memory, x_label="hours of the clock", y_label="MB")
    section.plot("soak", "Memory of five cars' cloud", draw)
    lost = sum(car.lost + abs(car.expected - soaked.sent[name]) for name, car in soaked.cars.items())
    section.ratio("samples lost over a soak", lost, 0, unit="samples")
    growth = round(soaked.growth, 4)
    section.ratio("growth of the emulator's memory, second quarter to last", growth, MOST_GROWTH)
    section.raw = asdict(soaked)
    return section


SECTION = Declared(
    "a week of the kept cloud, on a clock that is set forward",
    run,
    (
        Option("HOURS", int, 168, "of the clock"),
        Option("MINUTES", int, 4, "how long each car drives in each hour"),
    ),
    KEPT,
    cloud=False,
)


def main() -> None:
    """Soak in a folder."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--hours", type=int, required=True)
    parser.add_argument("--minutes", type=int, required=True)
    given = parser.parse_args()
    soak(given.folder, given.hours, given.minutes)


if __name__ == "__main__":
    main()
