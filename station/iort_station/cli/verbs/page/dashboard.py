"""`iort dashboard`: the live page."""

from __future__ import annotations

import threading
from typing import Annotated

import typer

from iort_station.cli.console import out
from iort_station.cli.options import Token
from iort_station.fleet import registry
from iort_station.page import keys

commands = typer.Typer()


@commands.command("dashboard")
def dashboard(
    context: typer.Context,
    port: Annotated[int, typer.Option(help="The page's port; 0 takes a free one.")] = 8080,
    host: Annotated[
        str, typer.Option(help="The address to listen on. Whoever reaches it can read the cars' past.")
    ] = "127.0.0.1",
    name: Annotated[
        list[str] | None,
        typer.Option(help="Another name of this server than localhost; may be repeated."),
    ] = None,
    token: Token = "",
) -> None:
    """Serve the live page until Ctrl-C: the fleet, each car, its past, and CloudWatch's dashboards."""
    # numpy and aiohttp take longer to load than most commands to run.
    from iort_station.page.answers import actions, answers  # noqa: PLC0415 - see above
    from iort_station.page.downloads import downloads  # noqa: PLC0415 - as above
    from iort_station.page.server import PageServer  # noqa: PLC0415 - as above

    cloud = context.obj.cloud()
    with PageServer(
        namespace=cloud.namespace,
        vehicles=registry.vehicles(cloud),
        token=token,
        answers=answers(cloud),
        downloads=downloads(cloud),
        actions=actions(cloud),
        host=host,
        port=port,
        names=name or (),
        **keys.load(cloud).reading(),
    ) as page:
        out.print(f"{page.url}  (Ctrl-C stops)")
        threading.Event().wait()
