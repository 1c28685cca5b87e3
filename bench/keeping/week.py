"""Runs the soak in a process with its own clock, and judges what it says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from bench.keeping import clock
from bench.keeping.counted import Counted, counted
from bench.keeping.soak import CARS, Look
from testkit import ROOT
from testkit.command import Table
from testkit.waiting import InstrumentError

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

    @property
    def good(self) -> bool:
        """Whether nothing is lost and the memory is flat."""
        lost = any(one.lost or one.expected != self.sent[name] for name, one in self.cars.items())
        return not lost and self.growth < MOST_GROWTH

    def as_json(self) -> dict[str, Any]:
        return {**asdict(self), "growth": round(self.growth, 4)}

    @classmethod
    def of_json(cls, figures: dict[str, Any]) -> Soak:
        """The figures that `as_json` returned."""
        looks = [Look(**one) for one in figures["looks"]]
        cars = counted(figures["cars"])
        return cls(figures["hours"], figures["minutes"], looks, figures["sent"], cars)

    def table(self) -> Table:
        """A row for each of a few hours."""
        step = max(1, len(self.looks) // 8)
        shown = [*self.looks[::step], self.looks[-1]]
        head = ("hour", "batches", "emulator MB", "functions MB", "ledger MB", "files MB", "after s")
        rows = [
            (
                f"{one.hour}",
                f"{one.batches:,}",
                f"{one.emulator_mb:.0f}",
                f"{one.functions_mb:.0f}",
                f"{one.ledger_mb:.0f}",
                f"{one.files_mb:.0f}",
                f"{one.seconds:.0f}",
            )
            for one in dict.fromkeys(shown)
        ]
        lost = sum(one.lost for one in self.cars.values())
        title = (
            f"{CARS} cars, {self.minutes} min at 50 Hz in each of {self.hours} hours: {lost} lost, "
            f"memory {self.growth:+.1%} from the second quarter to the last"
        )
        return Table(title, head, rows)


def soak(folder: Path, hours: int, minutes: int, say: Callable[[str], None]) -> Soak:
    """Soak in a process of its own; raises `InstrumentError` if it fails."""
    folder.mkdir(parents=True)
    command = [sys.executable, "-m", "bench.keeping.soak", str(folder)]
    command += ["--hours", str(hours), "--minutes", str(minutes)]
    environment = {**os.environ, **clock.environment(folder)}
    looks: list[Look] = []
    end: dict[str, Any] = {}
    say("starting the cloud of the soak")
    with subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True) as process:
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
    return Soak(hours, minutes, looks, end["sent"], counted(end["found"]))
