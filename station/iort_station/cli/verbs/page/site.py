"""`iort site`: the page on the web."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, TrackFile, Yes, agreed
from iort_station.cli.words import examples
from iort_station.page.motion import everybody
from iort_station.page.page import config, load_track, publish, upload

commands = typer.Typer()


@commands.command("site", epilog=examples("site"))
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
    track: TrackFile = None,
    yes: Yes = False,
    as_json: AsJson = False,
) -> None:
    """Upload the page to the stack iort-site, which serves it. Deploy with -c site=true first."""
    cloud = context.obj.cloud()
    if remove:
        agreed(f"Take the page of the deployment {cloud.namespace} down?", yes=yes)
        gone = upload(cloud.client("s3"), cloud.output("site", "PageBucket"), {})
        tell({"deleted": len(gone)}, f"{len(gone)} files deleted", as_json=as_json)
        return
    told = config(
        namespace=cloud.namespace,
        token=token,
        track=None if track is None else load_track(track),
        **everybody(cloud),
    )
    url = publish(cloud, told)
    tell({"url": url}, url, as_json=as_json)
