"""`iort site`: the page on the web."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import out
from iort_station.cli.options import Yes, agreed
from iort_station.fleet import registry
from iort_station.page import keys
from iort_station.page.page import config
from iort_station.page.site import publish, upload

commands = typer.Typer()


@commands.command("site")
def site(
    context: typer.Context,
    token: Annotated[
        str,
        typer.Option(
            envvar="PUBNUB_ACCESS_TOKEN",
            help="PubNub's access token for reading. Everybody who opens the page can read it.",
        ),
    ] = "",
    remove: Annotated[
        bool, typer.Option("--remove", help="Empty the bucket instead, before you destroy the stack.")
    ] = False,
    yes: Yes = False,
) -> None:
    """Upload the page to the stack iort-site, which serves it. Deploy with -c site=true first."""
    cloud = context.obj.cloud()
    if remove:
        agreed(f"Take the page of the deployment {cloud.namespace} down?", yes=yes)
        gone = upload(cloud.client("s3"), cloud.output("site", "PageBucket"), {})
        out.print(f"{len(gone)} files deleted")
        return
    vehicles, pubnub = registry.vehicles(cloud), keys.load(cloud).reading()
    out.print(publish(cloud, config(namespace=cloud.namespace, vehicles=vehicles, token=token, **pubnub)))
