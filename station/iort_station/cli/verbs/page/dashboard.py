"""`iort dashboard`: the live page."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from iort_station.cli.console import Console
from iort_station.fleet import registry
from iort_station.page import keys

commands = typer.Typer()
_out = Console()


@commands.command("dashboard")
def dashboard(
    context: typer.Context,
    port: Annotated[int, typer.Option(help="The page's port; 0 for a free one.")] = 8080,
    host: Annotated[
        str, typer.Option(help="The address to listen on. Whoever reaches it can read the cars' past.")
    ] = "127.0.0.1",
    name: Annotated[
        list[str] | None,
        typer.Option(help="Another name by which the page is reached than localhost; again for more."),
    ] = None,
    token: Annotated[
        str,
        typer.Option(
            envvar="PUBNUB_ACCESS_TOKEN",
            help="PubNub's access token to read with, where Access Manager is on.",
        ),
    ] = "",
) -> None:
    """Serve the live page until Ctrl-C: the fleet, each car, its past, and CloudWatch's dashboards."""
    # numpy and aiohttp take longer to load than most commands to run.
    from iort_station.page.answers import answers  # noqa: PLC0415 - see above
    from iort_station.page.server import PageServer  # noqa: PLC0415 - as above

    cloud = context.obj.cloud()
    pubnub_keys = keys.load(cloud)
    with PageServer(
        namespace=cloud.namespace,
        vehicles=registry.vehicles(cloud),
        token=token,
        answers=answers(cloud),
        host=host,
        port=port,
        names=name or (),
        **pubnub_keys.reading(),
    ) as page:
        _out.print(f"{page.url}  (Ctrl-C stops)")
        threading.Event().wait()
