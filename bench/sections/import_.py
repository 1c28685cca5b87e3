"""The speed of `iort import` into the archive, beside reading the same bag with rosbags alone.

A script makes the bag. Three processes read it: one that only takes its messages, one that deserializes each,
as the examples of rosbags do, and `iort import`. The operating system measures their processor time and their
memory. Then the import is audited, queried and exported, and compared with the bag.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from rosbags.rosbag2 import Reader

from bench.report import Report, Section
from bench.sections import Declared, Option
from iort_station import data
from iort_station.cloud import EMBEDDED
from testkit.bags import BYTES_A_SECOND, STREAMS, TOPICS, speed, written
from testkit.target import Say, Target
from testkit.waiting import InstrumentError

# The most: as a multiple of what rosbags takes to read and deserialize.
TIMES = 3.0
_IORT = Path(sys.executable).parent / "iort"
_READ = """
import sys
from pathlib import Path
from rosbags.highlevel import AnyReader
with AnyReader([Path(sys.argv[1])]) as reader:
    for connection, _, raw in reader.messages():
        if sys.argv[2] == "deserialize":
            reader.deserialize(raw, connection.msgtype)
"""


class Taken(NamedTuple):
    """What a process took: seconds of processor time, its peak of memory in MB, and its output."""

    cpu_s: float
    peak_mb: float
    output: str


def run(target: Target | None, say: Say, *, megabytes: int) -> Section:
    """Make a bag of so many megabytes, import it, and compare."""
    assert target is not None
    section, seconds = Section("import", "Importing recordings"), megabytes * 1e6 / BYTES_A_SECOND
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag = folder / "drive"
        say(f"a bag of {megabytes} MB")
        messages = written(bag, "mcap", seconds=seconds)
        target.cloud.save(folder / EMBEDDED.name)
        robot = target.robot("imported").robot
        iort = [str(_IORT), "--local", "--embedded", str(folder / EMBEDDED.name)]
        say("rosbags")
        read, deserialized = (
            _taken(sys.executable, "-c", _READ, str(bag), how) for how in ("read", "deserialize")
        )
        say("iort import")
        imported = _taken(*iort, "import", str(bag), robot, "--archive", "--json")
        (facts,) = json.loads(imported.output)["recordings"]
        say("audit, query, export")
        _taken(*iort, "audit", robot)
        _taken(*iort, "archive", "verify", robot)
        _taken(*iort, "export", robot, "--last", "all", "--out", str(folder / "out"))
        _compare(target, robot, bag, folder / "out")
    size = facts["bytes"] / 1e6
    section.table(
        f"A bag of {size:,.0f} MB with {messages:,} messages",
        ["process", "processor time", "MB a second", "peak of memory"],
        [
            [what, f"{one.cpu_s:.1f} s", f"{size / one.cpu_s:.0f}", f"{one.peak_mb:.0f} MB"]
            for what, one in (
                ("rosbags, messages as bytes", read),
                ("rosbags, deserialized", deserialized),
                ("iort import into the archive", imported),
            )
        ],
    )
    section.ratio("import beside rosbags that deserializes", imported.cpu_s / deserialized.cpu_s, TIMES)
    section.ratio("import beside rosbags that only reads bytes", imported.cpu_s / read.cpu_s, None)
    section.notes.append("Audited complete, verified, queried, exported as ROS 2, and equal byte for byte.")
    section.raw.update(
        messages=messages, megabytes=size, peak_mb=imported.peak_mb,
        import_s=imported.cpu_s, deserialize_s=deserialized.cpu_s, read_s=read.cpu_s,
    )  # fmt: skip
    return section


def _taken(*command: str) -> Taken:
    """Run a command to its end. Raises `InstrumentError` if it fails."""
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.PIPE)
        assert process.stderr is not None
        problem = process.stderr.read().decode()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        process.stderr.close()
        out.seek(0)
        output = out.read().decode()
    if process.returncode:
        raise InstrumentError(f"{' '.join(command[:8])}: {(problem or output)[-500:]}")
    return Taken(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, output)


def _compare(target: Target, robot: str, bag: Path, exported: Path) -> None:
    """Raise `InstrumentError` unless everything is there as it was."""
    before, after = _messages(bag), _messages(exported)
    for topic in TOPICS:
        if before[topic.name] != after[topic.name]:
            raise InstrumentError(f"{topic.name} was exported with other messages than it was imported with")
    found = data.query(target.cloud, robot, STREAMS["/sensors/core"], fields=["speed"])
    if found.columns["speed"].tolist() != [speed(i) for i in range(len(before["/sensors/core"]))]:
        raise InstrumentError("a query gives other values than the bag has")


def _messages(folder: Path) -> dict[str, list[int]]:
    """The hashes of the messages of a recording, in order, by topic."""
    found: dict[str, list[int]] = {topic.name: [] for topic in TOPICS}
    with Reader(folder) as reader:
        for connection, _, raw in reader.messages():
            found[connection.topic].append(hash(bytes(raw)))
    return found


SECTION = Declared(
    "the import of a bag into the archive, beside rosbags",
    run,
    (Option("MEGABYTES", int, 500, "size of the bag, about"),),
    Report("import", "Importing recordings", "make bench ONLY=import"),
)
