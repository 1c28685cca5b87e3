"""`iort bridge`: robots live, or what they have recorded, for Foxglove, Lichtblick and PlotJuggler."""

from __future__ import annotations

import secrets
import socket
import ssl
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ
from iort_station import kept
from iort_station.cli import options
from iort_station.cli.console import Lines, tell
from iort_station.cli.options import AsJson, Blind, LiveWay, Token, When, argument, examples, option, ranged
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.fleet.roles import transport
from iort_station.fleet.seat import Seat, driver_of
from iort_station.times import iso_s
from iort_station.upkeep.snapshot import VERSION

if TYPE_CHECKING:
    from iort_station.bridge.serving import Access, Served
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
    listen: Annotated[
        str,
        option("The address to listen on. Anyone elsewhere needs the page's password.", metavar="ADDRESS"),
    ] = "127.0.0.1",
    certificate: Annotated[
        Path | None,
        option(
            "A PEM file with key and certificate, for wss. Default: the page's of `make up`.", metavar="FILE"
        ),
    ] = None,
    origin: Annotated[
        list[str] | None,
        option("A web page that may connect, such as https://lichtblick.lab; may be repeated."),
    ] = None,
    drive: Annotated[
        bool, option("Let a tool's teleop panel drive the one robot, by /cmd_vel.", "--drive")
    ] = False,
    max_speed: Annotated[
        float, option("The top speed of --drive in m/s; at most the car's own limit.", min=0.01)
    ] = 1.0,
    by: Annotated[str | None, option("Who drives, as others see it. Default: the user.")] = None,
    blind: Blind = False,
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
    from iort_station.bridge.serving import playing, serving  # noqa: PLC0415 - as above

    names = list(dict.fromkeys(robots or ()))
    access = _access(context, listen, port, certificate, origin or (), keyed=drive)
    with ExitStack() as stack:
        if incident or when != When() or any(name.endswith(_MCAP) for name in names):
            if drive:
                raise UsageError("the past cannot be driven: --drive is for a robot that is live")
            source, title = stack.enter_context(_stored(context, when, names, incident))
            extent = f"{iso_s(source.start_ns // 1000)} to {iso_s(source.end_ns // 1000)}"
            what = f"plays {title}, {extent}"
            served = stack.enter_context(playing(source, title, access))
        else:
            cloud = context.obj.cloud()
            if drive and len(names) != 1:
                raise UsageError("--drive needs the name of one robot")
            names = names or _every_robot(cloud)
            what = f"{', '.join(names)}, live"
            seat = None
            if drive:
                driver = driver_of(cloud, names[0], by=by, top_mps=max_speed, blind=blind)
                seat = Seat(cloud, names[0], driver)
            way = live or transport(cloud)
            lanes = serving(cloud, names, access, way=way, rate_hz=rate, token=token, seat=seat)
            served = stack.enter_context(lanes)
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


def _access(
    context: typer.Context,
    listen: str,
    port: int,
    certificate: Path | None,
    origins: Sequence[str],
    *,
    keyed: bool,
) -> Access:
    """Who may come in: on loopback everybody, or with ``keyed`` who has the key that is printed; elsewhere
    who has the password."""
    from iort_station.bridge.door import ByPassword, one_key  # noqa: PLC0415 - as above
    from iort_station.bridge.serving import Access  # noqa: PLC0415 - as above
    from iort_station.page.password import Password, first_password  # noqa: PLC0415 - as above
    from iort_station.page.server import on_loopback  # noqa: PLC0415 - as above

    if on_loopback(listen):
        if not keyed:
            return Access(host=listen, port=port, origins=origins, context=_tls(certificate))
        # Other users of this machine reach it, too.
        key = secrets.token_urlsafe(16)
        tls = _tls(certificate)
        return Access(host=listen, port=port, origins=origins, context=tls, key=key, admits=one_key(key))
    file: Path | None = context.obj.file()
    kept_folder = file.parent if file is not None and (file.parent / VERSION).exists() else None
    folder = kept_folder or kept.bridge()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    password = Password(folder)
    if new := password.make():
        if kept_folder:
            options.say(f"the {first_password(new, 'make up-password', sys.stderr)}")
        else:
            known = f"password {new}, shown once" if sys.stderr.isatty() else "password is not shown here"
            options.say(f"the {known}: remove {folder}/page-password, and the next start makes another")
    pages = kept.page_certificate(kept_folder) if kept_folder else None
    tls = _tls(certificate or pages)
    if tls is None:
        options.say("without TLS everybody on the way can read the password and the data: give --certificate")
    return Access(
        host=listen,
        port=port,
        origins=origins,
        context=tls,
        admits=ByPassword(password),
        # Nobody can read it from its hash, so the reader fills it in.
        key="PASSWORD",
        shown=socket.gethostname() if listen in {"0.0.0.0", "::"} else "",  # noqa: S104 - compared
    )


def _tls(certificate: Path | None) -> ssl.SSLContext | None:
    if certificate is None:
        return None
    # aiohttp takes longer to load than most commands to run.
    from iort_station.page.background import tls_context  # noqa: PLC0415 - as above

    try:
        return tls_context(certificate)
    except OSError as error:
        raise StationError(f"{certificate} must be a PEM file with key and certificate: {error}") from error


def _tell(served: Served, what: str, *, as_json: bool) -> None:
    facts = {"url": served.url, "serves": what, "foxglove": served.desktop, "web": served.web}
    lines = [
        f"{what}  (Ctrl-C stops)",
        f"  address            {served.url}",
        f"  Foxglove           {served.desktop}",
        f"  app.foxglove.dev   {served.web}",
    ]
    tell(facts, Lines("\n".join(lines)), as_json=as_json)
