"""A week of five cars on a kept cloud, on a clock that is set forward while nothing is under way.

In each hour of the clock every car drives so many minutes at 50 Hz, a batch a second, as fast as the broker
acknowledges. When everything is summarised the clock is set to the next hour: records of streams, sessions,
metrics and items expire and the archive takes its hours by that clock. The soak is a process with its own
clock, this module again, which writes a JSON object a line.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from bench import plots
from bench.load.counting import Counted, count, process, summarized_ends
from bench.load.generator import Load, Robot, laps
from bench.report import KEPT, Section
from bench.sections import Declared, Option
from iort_station.cloud import Cloud
from iort_station.fleet import robots
from local.cloud import EmbeddedCloud
from testkit import machine
from testkit.target import Say, Target
from testkit.waiting import InstrumentError, until

_FILE, _PRELOAD = "BENCH_CLOCK", "LD_PRELOAD"
CARS, RATE_HZ = 5, 50
_HOUR_S = 3_600
# Batches of a car that wait for their acknowledgement.
_WINDOW = 20
_CONNECT_S, _SUMMARY_S, _IDLE_S = 60.0, 180.0, 600.0
_QUIET_S = 0.5
# Growth from the second quarter of the hours to the last: less than measuring varies.
MOST_GROWTH = 0.1


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


def set_clock(forward_s: int) -> None:
    """Set the clock so far forward for this process, which has an `environment`, and for all below it."""
    # They have it mapped: it must stay the same file.
    with Path(os.environ[_FILE]).open("r+b") as file:
        file.write(struct.pack("=q", forward_s))


@dataclass(frozen=True)
class Look:
    """What the cloud takes after so many hours of the clock; memory without what processes share."""

    hour: int
    batches: int
    emulator_mb: float
    functions_mb: float
    ledger_mb: float
    files_mb: float
    after_s: float


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
        return fmean(look.emulator_mb for look in late) / fmean(look.emulator_mb for look in early) - 1


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
        until(
            lambda: len(self.sent_ms) - len(self.acknowledged) <= most,
            f"the acknowledgements of {self.name}",
            _CONNECT_S,
            poll_s=0.005,
        )


def soak(folder: Path, hours: int, minutes: int) -> None:
    """Drive through the hours; say how it goes, and at the end what is stored."""
    forward_s, inherited = 0, {name: os.environ[name] for name in (_PRELOAD, _FILE)}
    with EmbeddedCloud(
        folder / "cloud", kept=True, any_ports=True, live="iot", environment=inherited
    ) as embedded:
        cloud = embedded.cloud
        cars, began = _cars(cloud, folder), time.monotonic()
        for hour in range(hours):
            _drive(cars, minutes * 60)
            for car in cars:
                until(
                    lambda car=car: summarized_ends(cloud, car.name)[-1:] >= [car.last_s],  # type: ignore[misc]  # bound now
                    f"the summaries of {car.name}",
                    _SUMMARY_S,
                )
            _wait_until_idle(embedded)
            batches = sum(len(car.sent_ms) for car in cars)
            _say(look=asdict(_look(embedded, hour + 1, batches, time.monotonic() - began)))
            forward_s += _HOUR_S - int(time.time()) % _HOUR_S
            set_clock(forward_s)
        for car in cars:
            car.client.stop()
        counted = {car.name: asdict(count(cloud, car.name)) for car in cars}
        _say(cars=counted, sent={car.name: len(car.sent_ms) * RATE_HZ for car in cars})


def _cars(cloud: Cloud, folder: Path) -> list[Car]:
    names = [f"car{i + 1}" for i in range(CARS)]
    bundles = {name: str(robots.add(cloud, name, out=folder / "cars").folder) for name in names}
    load = Load(bundles, cloud.namespace, cloud.mqtt_endpoint, cloud.mqtt_port, 0, RATE_HZ)
    seconds = laps(RATE_HZ)
    cars = [
        Car(name, Path(path), load, seconds[i:] + seconds[:i])
        for i, (name, path) in enumerate(bundles.items())
    ]
    for car in cars:
        car.client.start()
    for car in cars:
        until(car.connected.is_set, f"the connection of {car.name}", _CONNECT_S)
    return cars


def _drive(cars: list[Car], seconds: int) -> None:
    first_s = int(time.time()) + 1
    driving = [threading.Thread(target=car.drive, args=(first_s, seconds)) for car in cars]
    for thread in driving:
        thread.start()
    for thread in driving:
        thread.join()


def _wait_until_idle(embedded: EmbeddedCloud) -> None:
    """Wait until no task of the archive is left and no function works: the clock must not jump meanwhile. A
    task that failed is hidden until its queue gives it out again, by that clock."""
    sqs, emulator = embedded.cloud.client("sqs"), embedded.emulator.pid
    [tasks] = [url for url in sqs.list_queues()["QueueUrls"] if "ArchiveTasks" in url]

    def idle() -> bool:
        before = machine.usage_below(emulator).cpu_s
        counts = sqs.get_queue_attributes(QueueUrl=tasks, AttributeNames=["All"])["Attributes"]
        threading.Event().wait(_QUIET_S)
        quiet = machine.usage_below(emulator).cpu_s == before
        return quiet and not int(counts["ApproximateNumberOfMessages"])

    until(idle, "the end of the functions' work", _IDLE_S)


def _look(embedded: EmbeddedCloud, hour: int, batches: int, after_s: float) -> Look:
    emulator = embedded.emulator.pid
    return Look(
        hour=hour,
        batches=batches,
        emulator_mb=_private_mb(emulator),
        functions_mb=round(sum(map(_private_mb, machine.descendants(emulator))), 1),
        ledger_mb=_disk_mb(embedded.folder.glob("ledger.db*")),
        files_mb=_disk_mb((embedded.folder / "s3").rglob("*")),
        after_s=round(after_s, 1),
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


def in_process(folder: Path, hours: int, minutes: int, say: Say) -> Soak:
    """Soak in a process of its own, with which its cloud ends; raises `InstrumentError` if it fails."""
    folder.mkdir(parents=True)
    own, looks, end = {**os.environ, **environment(folder)}, list[Look](), dict[str, Any]()
    say("starting the cloud of the soak")
    arguments = ("bench.sections.soak", str(folder), str(hours), str(minutes))
    with process(*arguments, environment=own) as objects:
        for said in objects:
            if "look" in said:
                looks.append(Look(**said["look"]))
                say(f"hour {looks[-1].hour} of {hours}: {looks[-1].emulator_mb:.0f} MB")
            else:
                end = said
    cars = {
        name: Counted(**{**car, "incomplete": tuple(car["incomplete"])}) for name, car in end["cars"].items()
    }
    return Soak(hours, minutes, looks, end["sent"], cars)


def run(_target: Target | None, say: Say, *, hours: int, minutes: int) -> Section:
    """Soak for so many hours of the clock."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        return report(in_process(Path(folder) / "soak", hours, minutes, say))


def report(soaked: Soak) -> Section:
    """A row for each of a few hours, the picture, and whether the memory grows."""
    section, looks = Section("soak", f"{soaked.hours} hours of the clock"), soaked.looks
    shown = dict.fromkeys([*looks[:: max(1, len(looks) // 8)], looks[-1]])
    section.table(
        f"{CARS} cars, {soaked.minutes} min at 50 Hz in each of {soaked.hours} hours",
        ["hour", "batches", "emulator MB", "functions MB", "ledger MB", "files MB", "after s"],
        ([f"{value:,.0f}" for value in asdict(look).values()] for look in shown),
    )
    memory = {
        "emulator": [look.emulator_mb for look in looks],
        "functions": [look.functions_mb for look in looks],
    }
    hours = [look.hour for look in looks]
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


if __name__ == "__main__":
    soak(Path(sys.argv[1]), *map(int, sys.argv[2:]))
