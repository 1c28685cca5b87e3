"""`iort sight`: what the driver of each motion command saw, and how old it was."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from botocore.exceptions import ClientError

from iort_contract.catalog.streams import DRIVE_STREAM
from iort_contract.messages.recorder import UPLOADED
from iort_contract.ros.decode import stamp_ns
from iort_contract.ros.definition import short_kind
from iort_station.cli import options
from iort_station.cli.console import bar, out, print_json, reading
from iort_station.cli.options import AsJson, Force, Robot, When, examples, option, ranged, say
from iort_station.cli.verbs.incidents import file_of
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import files
from iort_station.output import whole
from iort_station.times import iso, stamped

if TYPE_CHECKING:
    from iort_station.data.sight import Seen, Sight

commands = typer.Typer()
_CDR = "cdr"


@commands.command("sight", epilog=examples("sight car7 --last 5m", "sight car7 --last 1h --pictures seen"))
@ranged
def sight(
    context: typer.Context,
    robot: Robot,
    when: When,
    pictures: Annotated[
        Path | None,
        option("Write the pictures that incidents have into this folder, by number.", metavar="DIR"),
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Print for each motion command what its driver saw, and how old that was when the command came.

    A command names the newest picture on the driver's screen, if the robot has video. The age is by the
    robot's own clock. Of refused commands the robot records ten a second at most. The pictures themselves are
    there for the time of an incident, from the event recorder. The default range is the last five minutes.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station.data import inventory  # noqa: PLC0415 - see above
    from iort_station.data.sight import sight as read  # noqa: PLC0415 - as above

    within, cloud = when.range(options.SHORT), context.obj.cloud()
    with reading(f"{robot} {DRIVE_STREAM}", within.start_us, within.end_us) as progress:
        found = read(cloud, robot, within.start_us, within.end_us, progress=progress)
    written = None if pictures is None else _write(cloud, robot, found.commands, pictures, force=force)
    if as_json:
        told = {"robot": robot, "summary": found.figures(), "commands": list(map(_as_json, found.commands))}
        print_json(
            told if written is None else {**told, "pictures": {"written": len(written), "dir": str(pictures)}}
        )
    elif found.commands:
        _print(robot, found)
    options.say_refused(found.refused, found.reason)
    if not found.commands and (extent := inventory.extent(cloud, robot, DRIVE_STREAM)):
        say(f"no motion commands in this range; {robot} has {DRIVE_STREAM} from {extent[0]} to {extent[1]}")
    if written is not None and pictures is not None:
        named = len(_named(found.commands))
        say(f"{len(written):,} of the {named:,} pictures are in {pictures}; no incident has the others")


def _print(robot: str, found: Sight) -> None:
    import numpy as np  # noqa: PLC0415 - as above

    from iort_station.cli import tables  # noqa: PLC0415 - as above
    from iort_station.data import Result  # noqa: PLC0415 - as above

    rows = found.commands
    columns: dict[str, list[Any]] = {
        "by": [one.by for one in rows],
        "outcome": [f"{one.outcome}, ends" if one.ends else one.outcome for one in rows],
        "picture": [one.frame for one in rows],
        "captured": [None if one.captured_us is None else _clock(one.captured_us) for one in rows],
        "age ms": [None if one.age_ms is None else f"{one.age_ms:.1f}" for one in rows],
        "blind": ["blind" if one.blind else None for one in rows],
        "speed": [one.speed for one in rows],
        "steering": [one.steering for one in rows],
    }
    arrays = {name: np.array(column, dtype=object) for name, column in columns.items()}
    times = np.array([one.t_us for one in rows], dtype=np.int64)
    result = Result(robot, DRIVE_STREAM, times, arrays)
    shown = tables.write(result, sys.stdout, out.width if sys.stdout.isatty() else None)
    for line in _summary(found.figures()):
        out.print(line, soft_wrap=True, highlight=False)
    if shown.rows < len(result):
        say(f"{shown.rows} of {len(result):,} shown; a pipe gets every one")
    if shown.left_out:
        say(f"no room for {', '.join(shown.left_out)}: use a wider terminal, or --json")


def _summary(figures: Mapping[str, Any]) -> Iterator[str]:
    count = figures["commands"]
    share = f"{figures['with_picture'] / count:.1%}".replace("%", " %")
    named, blind = figures["with_picture"], figures["blind"]
    yield f"{count:,} commands; {named:,} name a picture ({share}); blind {blind:,}"
    if figures["age_p50_ms"] is not None:
        p50, p95, longest = (figures[f"age_{name}_ms"] for name in ("p50", "p95", "longest"))
        yield (
            f"{figures['by_sight']:,} taken by sight; the picture's age: p50 {p50:.1f} ms, p95 {p95:.1f} ms, "
            f"longest {longest:.1f} ms"
        )
    late, none = figures["picture_late"], figures["no_picture"]
    yield f"refused: {late:,} by a late picture, {none:,} without a picture"
    if figures["not_recorded"]:
        yield f"{figures['not_recorded']:,} name a picture that the stream video does not have"


def _as_json(one: Seen) -> dict[str, Any]:
    fields = asdict(one)
    return {**stamped("t", fields.pop("t_us")), **stamped("captured", fields.pop("captured_us")), **fields}


def _clock(t_us: int) -> str:
    """The time of the day, in milliseconds: the row has the day."""
    return iso(t_us).partition("T")[2][:-4]


# The pictures themselves, which the event recorder has kept.


class _Image(NamedTuple):
    """A picture: its capture time, and its file with the ending."""

    captured_us: int
    data: bytes
    ending: str


def _named(rows: Iterable[Seen]) -> dict[int, tuple[str, int]]:
    """The run and the number of each picture that a command names, by its capture time."""
    return {
        one.captured_us: (one.run, one.frame)
        for one in rows
        if one.captured_us is not None and one.frame is not None
    }


def _write(cloud: Cloud, robot: str, rows: Iterable[Seen], folder: Path, *, force: bool) -> list[Path]:
    """Write the pictures that incidents have; returns the files."""
    from iort_station.data.incidents import incidents  # noqa: PLC0415 - as above

    named = _named(rows)
    if folder.exists() and not folder.is_dir():
        raise StationError(f"{folder} must be a folder")
    folder.mkdir(parents=True, exist_ok=True)
    # Two runs may have a number in common.
    several = len({run for run, _ in named.values()}) > 1
    written: dict[int, Path] = {}
    for one in incidents(cloud, robot, min(named), max(named) + 1) if named else ():
        file = file_of(cloud, one) if one.incident.state == UPLOADED else None
        for image in _images(cloud, file, named.keys() - written.keys()) if file is not None else ():
            run, number = named[image.captured_us]
            path = folder / f"{f'{run[:8]}-' if several else ''}{number}.{image.ending}"
            with whole(path, force=force) as part:
                part.write_bytes(image.data)
            written[image.captured_us] = path
    return list(written.values())


def _images(cloud: Cloud, file: files.StoredFile, wanted: set[int]) -> Iterator[_Image]:
    """The pictures of an incident's file that were captured at the wanted times, each once. What cannot be
    read is said."""
    from iort_station.bridge.stored import McapFile  # noqa: PLC0415 - as above
    from iort_station.data.images import COMPRESSED, IMAGE, Images  # noqa: PLC0415 - as above

    with tempfile.TemporaryDirectory(prefix="iort-sight-") as temporary:
        try:
            with bar(file.name, file.size) as progress:
                path = files.download(cloud, file, Path(temporary), progress)
            incident = McapFile(path)
            cameras = {
                number: Images(topic.schema, topic.definition.decode("utf-8", "replace"))
                for number, topic in enumerate(incident.topics)
                if short_kind(topic.schema) in {COMPRESSED, IMAGE}
            }
            messages = incident.messages(incident.start_ns, frozenset(cameras), lambda: None, lambda _: None)
            for message in messages if cameras else ():
                ns = stamp_ns(message.data, ros2=incident.topics[message.topic].encoding == _CDR)
                if ns is None or ns // 1000 not in wanted:
                    continue
                wanted.discard(ns // 1000)
                try:
                    image = _Image(ns // 1000, *cameras[message.topic].file(message.data))
                except StationError as error:
                    say(f"{file.name}: the picture of {iso(ns // 1000)}: {error}")
                    continue
                yield image
        except (StationError, ClientError) as error:
            say(f"{file.name}: {error}")
