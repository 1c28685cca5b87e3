"""`iort export --format lerobot`: a dataset for learning from drives, runs or incidents."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal, get_type_hints

from iort_contract.messages.recorder import UPLOADED
from iort_station.cli import options
from iort_station.cli.console import counted, reading, tell
from iort_station.cli.options import Range, option, spread
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError, unknown
from iort_station.fleet import files, registry

if TYPE_CHECKING:
    from iort_station.data.episodes import Field, Source

_MOST_FPS = 240
_MOST_RUNS = 100_000


@dataclass(frozen=True)
class Learning:
    """The options of a dataset, as they were given; a verb has them by `learned`."""

    episodes: Annotated[
        Literal["drives", "runs", "incidents"] | None,
        option("For lerobot: what becomes episodes. Default: the analysed drives that begin in the range."),
    ] = None
    state: Annotated[
        str | None,
        option("For lerobot: the state, as STREAM.FIELD with commas. Default: the values of vesc."),
    ] = None
    action: Annotated[
        str | None,
        option("For lerobot: the action, as STREAM.FIELD with commas. Default: the command topics."),
    ] = None
    cameras: Annotated[
        str | None, option("For lerobot: streams of images, separated by commas. Default: none.")
    ] = None
    fps: Annotated[int | None, option("For lerobot: steps a second. Default: 20.")] = None
    task: Annotated[str | None, option("For lerobot: what the robot does. Default: drive.")] = None

    @property
    def given(self) -> bool:
        """Whether any option is given."""
        return self != Learning()


learned = spread("learning", get_type_hints(Learning, include_extras=True), Learning)


def export(
    cloud: Cloud,
    robot: str,
    within: Range,
    out: Path,
    learning: Learning,
    *,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Write the dataset; raises `StationError` and `UsageError`."""
    # numpy and pyarrow take longer to load than most commands to run.
    from iort_station.data import inventory  # noqa: PLC0415 - see above
    from iort_station.data.episodes import Shape, field_of, usual_fields  # noqa: PLC0415 - as above
    from iort_station.data.lerobot import write  # noqa: PLC0415 - as above

    fps = 20 if learning.fps is None else learning.fps
    if not 1 <= fps <= _MOST_FPS:
        raise UsageError(f"--fps must be 1 to {_MOST_FPS}, got {fps}")
    state, action = (
        tuple(map(field_of, options.names(text) or ())) for text in (learning.state, learning.action)
    )
    cameras = tuple(dict.fromkeys(options.names(learning.cameras) or ()))
    streams = inventory.check_recorded(cloud, robot)
    usual = ((), ()) if state and action else usual_fields(cloud, robot)
    state, action = state or usual[0], action or usual[1]
    for name, chosen in (("--state", state), ("--action", action)):
        if not chosen:
            raise UsageError(
                f"{robot} has no usual fields for {name}: give it, with fields of `iort streams {robot}`"
            )
    shape = Shape(fps=fps, state=state, action=action, cameras=cameras)
    named = list(dict.fromkeys((*(field.stream for field in shape.fields), *cameras)))
    # An incident's file may have streams that are not recorded.
    if learning.episodes != "incidents" and (missing := [name for name in named if name not in streams]):
        raise unknown(f"{robot} has no stream {missing[0]}", missing, streams, f"iort streams {robot}")
    units = {field: _unit(cloud, robot, field) for field in shape.fields if field.stream in streams}
    with TemporaryDirectory() as folder, reading(f"{robot}", within.start_us, within.end_us) as progress:
        sources = _sources(cloud, robot, within, learning.episodes or "drives", named, Path(folder))
        written = write(
            out,
            sources,
            shape,
            task=learning.task or "drive",
            robot=robot,
            units=units,
            force=force,
            progress=progress,
        )
    counts = {**vars(written), "file": str(out), "fps": fps}
    made = f"{counted(written.episodes, 'episode')} of {counted(written.frames, 'frame')}"
    tell(counts, f"{out}: {made}", as_json=as_json)
    options.say(f"state: {', '.join(map(str, state))}")
    options.say(f"action: {', '.join(map(str, action))}")
    if written.left_out:
        kind = (learning.episodes or "drives").removesuffix("s")
        options.say(f"left out: {counted(written.left_out, kind)}; the first: {written.reason}")
    before = "the image before stands in place of each"
    if written.not_kept:
        images = counted(written.not_kept, "image")
        options.say(f"not kept by the robot: {images}; {before}. Incidents have every image")
    if written.damaged:
        options.say(f"cannot be shown: {counted(written.damaged, 'image')}; {before}")
    if written.resized:
        options.say(f"resized to the first of their camera: {counted(written.resized, 'image')}")


def _unit(cloud: Cloud, robot: str, field: Field) -> str:
    from iort_station.data import inventory  # noqa: PLC0415 - as above
    from iort_station.data.recorded import select  # noqa: PLC0415 - as above

    kind = inventory.kind_of(cloud, select(robot, field.stream))
    return inventory.unit(field.stream, field.name, kind=kind)


def _sources(
    cloud: Cloud, robot: str, within: Range, kind: str, streams: Sequence[str], folder: Path
) -> Iterator[Source | StationError]:
    """What becomes episodes, in order of time, or why it cannot; raises `StationError` for nothing at all."""
    from iort_station.data.episodes import Kept, Stored  # noqa: PLC0415 - as above
    from iort_station.data.findings import drives  # noqa: PLC0415 - as above
    from iort_station.data.incidents import incidents  # noqa: PLC0415 - as above
    from iort_station.data.runs import runs  # noqa: PLC0415 - as above

    start_us, end_us = within.start_us, within.end_us
    if kind == "drives":
        analysed = drives(cloud, robot, start_us, end_us)
        if not analysed:
            raise StationError(
                f"{robot} has no analysed drives in this range: run `iort analyse`, or give --episodes runs"
            )
        for drive in reversed(analysed):
            about = {"robot": robot, "drive": str(drive.drive)}
            yield Stored(cloud, robot, drive.drive.start_us, drive.end_us + 1, about)
    elif kind == "runs":
        answer = runs(cloud, robot, streams=streams, start_us=start_us, end_us=end_us, count=_MOST_RUNS)
        # The agent's own streams may have other times than a recording that it plays.
        whole = [run for run in answer["runs"] if run["streams"].keys() >= set(streams)]
        if not whole:
            raise StationError(f"{robot} has no run with all of {', '.join(streams)} in this range")
        for run in reversed(whole):
            parts = run["streams"].values()
            first = max(part["from_us"] for part in parts)
            end = min(part["to_us"] for part in parts)
            first = first if start_us is None else max(start_us, first)
            end = end if end_us is None else min(end_us, end)
            yield Stored(cloud, robot, first, end, {"robot": robot, "run": run["run"]})
    else:
        uploaded = [
            one for one in incidents(cloud, robot, start_us, end_us) if one.incident.state == UPLOADED
        ]
        if not uploaded:
            raise StationError(
                f"{robot} has no uploaded incidents in this range: see `iort incidents {robot}`"
            )
        vehicle = registry.vehicle_of(cloud, robot)
        for one in reversed(uploaded):
            file = files.stored(cloud, one.incident.key)
            if file is None or file.robot != robot:
                yield StationError(f"incident {one.incident.id} is not in the bucket any more")
                continue
            path = files.download(cloud, file, folder / one.incident.id)
            try:
                yield Kept(path, vehicle, {"robot": robot, "incident": one.incident.id})
            except StationError as error:
                yield error
            path.unlink()
