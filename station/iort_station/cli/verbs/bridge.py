"""`iort bridge`: robots live, or what they have recorded, for Foxglove, Lichtblick and PlotJuggler."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ
from iort_station.cli import options
from iort_station.cli.console import Lines, tell
from iort_station.cli.options import AsJson, LiveWay, Token, When, argument, examples, option, ranged
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.fleet.roles import transport
from iort_station.times import iso_s

if TYPE_CHECKING:
    from iort_station.bridge.serving import Served
    from iort_station.bridge.stored import Source

commands = typer.Typer()
_MCAP = ".mcap"


@commands.command("bridge", epilog=examples("bridge car7", "bridge car7 --last 1h"))
@ranged
def bridge(
    context: typer.Context,
    when: When,
    robots: Annotated[
        list[str] | None,
        argument("Robots, or one MCAP file. Default: all robots.", autocompletion=options.robots),
    ] = None,
    incident: Annotated[str | None, option("Play an incident's file, by its id.", metavar="ID")] = None,
    rate: Annotated[
        float,
        option("Live samples a second to ask of each stream.", min=LIVE_MIN_RATE_HZ, max=LIVE_MAX_RATE_HZ),
    ] = LIVE_MAX_RATE_HZ,
    port: Annotated[int, option("The port; 0 takes a free one.", min=0, max=65_535)] = 8765,
    origin: Annotated[
        list[str] | None,
        option("A web page that may connect, such as https://lichtblick.lab; may be repeated."),
    ] = None,
    live: LiveWay = None,
    token: Token = "",
    as_json: AsJson = False,
) -> None:
    """Serve robots for Foxglove, Lichtblick and PlotJuggler, live or past, until Ctrl-C.

    Without a range it is live: a robot sends while somebody looks at one of its topics. With a range, with
    --incident or for an MCAP file it plays what is stored: the tool plays, pauses, seeks and sets the speed.
    docs/how-to/foxglove.md shows each tool.
    """
    # They take longer to load than most commands to run.
    from iort_station.bridge.serving import Access, playing, serving  # noqa: PLC0415 - as above

    names = list(dict.fromkeys(robots or ()))
    access = Access(port=port, origins=origin or ())
    with ExitStack() as stack:
        if incident or when != When() or any(name.endswith(_MCAP) for name in names):
            source, title = stack.enter_context(_stored(context, when, names, incident))
            extent = f"{iso_s(source.start_ns // 1000)} to {iso_s(source.end_ns // 1000)}"
            what = f"plays {title}, {extent}"
            served = stack.enter_context(playing(source, title, access))
        else:
            cloud = context.obj.cloud()
            names = names or _every_robot(cloud)
            what = f"{', '.join(names)}, live"
            way = live or transport(cloud)
            served = stack.enter_context(serving(cloud, names, access, way=way, rate_hz=rate, token=token))
        _tell(served, what, as_json=as_json)
        threading.Event().wait()


@contextmanager
def _stored(
    context: typer.Context, when: When, names: Sequence[str], incident: str | None
) -> Iterator[tuple[Source, str]]:
    """What is to be played, and what it is called."""
    from iort_station.bridge.stored import McapFile, Range  # noqa: PLC0415 - as above

    files = [name for name in names if name.endswith(_MCAP)]
    if incident or files:
        if when != When() or len(names) + bool(incident) > 1:
            raise UsageError("give robots with a range, or one MCAP file, or --incident alone")
        if not incident:
            yield McapFile(Path(files[0])), Path(files[0]).name
            return
        from iort_station.cli.verbs.incidents import downloaded  # noqa: PLC0415 - as above

        with tempfile.TemporaryDirectory(prefix="iort-bridge-") as folder:
            path = downloaded(context.obj.cloud(), incident, Path(folder))
            yield McapFile(path), f"incident {incident}"
        return
    within = when.range()
    cloud = context.obj.cloud()
    names = names or _every_robot(cloud)
    yield Range(cloud, names, within.start_us, within.end_us), ", ".join(names)


def _every_robot(cloud: Cloud) -> list[str]:
    names = sorted(registry.presence(cloud))
    if not names:
        raise StationError("no robot is registered: `iort robots add` registers one")
    return names


def _tell(served: Served, what: str, *, as_json: bool) -> None:
    facts = {"url": served.url, "serves": what, "foxglove": served.desktop, "web": served.web}
    lines = [
        f"{what}  (Ctrl-C stops)",
        f"  address            {served.url}",
        f"  Foxglove           {served.desktop}",
        f"  app.foxglove.dev   {served.web}",
    ]
    tell(facts, Lines("\n".join(lines)), as_json=as_json)
