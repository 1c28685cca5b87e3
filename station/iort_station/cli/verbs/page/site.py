"""`iort site`: the page on the web."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import Console
from iort_station.fleet import registry
from iort_station.page import keys
from iort_station.page.page import config
from iort_station.page.site import publish, upload

commands = typer.Typer()
_out = Console()


@commands.command("site")
def site(
    context: typer.Context,
    token: Annotated[
        str,
        typer.Option(
            envvar="PUBNUB_ACCESS_TOKEN",
            help="PubNub's access token to read with. Everybody who opens the page can read it.",
        ),
    ] = "",
    remove: Annotated[
        bool, typer.Option("--remove", help="Empty the bucket instead, before the stack is destroyed.")
    ] = False,
) -> None:
    """Upload the page to where the stack iort-site serves it: deploy with -c site=true first."""
    cloud = context.obj.cloud()
    if remove:
        gone = upload(cloud.client("s3"), cloud.output("site", "PageBucket"), {})
        _out.print(f"{len(gone)} files are gone")
        return
    pubnub_keys = keys.load(cloud)
    told = config(
        namespace=cloud.namespace,
        vehicles=registry.vehicles(cloud),
        token=token,
        **pubnub_keys.reading(),
    )
    _out.print(publish(cloud, told))
