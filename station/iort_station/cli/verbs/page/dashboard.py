"""`iort dashboard`: the live page."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from iort_station import kept
from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, LiveWay, Token, TrackFile
from iort_station.cli.words import examples, say
from iort_station.fleet import registry
from iort_station.fleet.roles import transport

commands = typer.Typer()


@commands.command("dashboard", epilog=examples("dashboard --port 8080"))
def dashboard(
    context: typer.Context,
    port: Annotated[int, typer.Option(help="The page's port; 0 takes a free one.")] = 8080,
    host: Annotated[
        str,
        typer.Option(
            help="The address to listen on. Whoever reaches it can read the cars' past; "
            "only a page on 127.0.0.1 sends commands."
        ),
    ] = "127.0.0.1",
    name: Annotated[
        list[str] | None,
        typer.Option(help="Another name of this server than localhost; may be repeated."),
    ] = None,
    live: LiveWay = None,
    token: Token = "",
    track: TrackFile = None,
    as_json: AsJson = False,
) -> None:
    """Serve the live page until Ctrl-C: the fleet, each car, its past, and CloudWatch's dashboards."""
    # numpy and aiohttp take longer to load than most commands to run.
    from iort_station.page import answers as control  # noqa: PLC0415 - as above
    from iort_station.page.answers import actions, answers  # noqa: PLC0415 - see above
    from iort_station.page.history import downloads  # noqa: PLC0415 - as above
    from iort_station.page.motion import reaching  # noqa: PLC0415 - as above
    from iort_station.page.page import load_track  # noqa: PLC0415 - as above
    from iort_station.page.server import PageServer, on_loopback  # noqa: PLC0415 - as above

    cloud = context.obj.cloud()
    with PageServer(
        namespace=cloud.namespace,
        vehicles=registry.vehicles(cloud),
        token=token,
        answers=answers(cloud),
        downloads=downloads(cloud),
        open_actions=actions(cloud),
        # Only people at this machine may move a robot.
        actions=control.keyed_actions(cloud) if on_loopback(host) else {},
        admitted=lambda address: say(f"another browser: {address}"),
        track=None if track is None else load_track(track),
        host=host,
        port=port,
        invitations=kept.pages(),
        names=name or (),
        **reaching(cloud, live or transport(cloud)),
    ) as page:
        address = page.invitation()
        tell({"url": page.url, "address": address}, f"{address}  (Ctrl-C stops)", as_json=as_json)
        threading.Event().wait()
