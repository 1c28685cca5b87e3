"""`iort pubnub`: the keys that Lambda 1 publishes with."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import Console
from iort_station.errors import StationError
from iort_station.page import keys

commands = typer.Typer()
_out = Console()


@commands.command("pubnub")
def pubnub(
    context: typer.Context,
    publish_key: Annotated[
        str | None, typer.Option(envvar="PUBNUB_PUBLISH_KEY", help="Asked for where it is not given.")
    ] = None,
    subscribe_key: Annotated[
        str | None, typer.Option(envvar="PUBNUB_SUBSCRIBE_KEY", help="Asked for where it is not given.")
    ] = None,
) -> None:
    """Store PubNub's keys, encrypted, where Lambda 1 reads them."""
    # Before anybody types a key for a cloud that is not there.
    cloud = context.obj.cloud()
    if cloud.endpoint_url:
        raise StationError("the embedded cloud has a stand-in for PubNub, with keys of its own")
    publish_key = publish_key or typer.prompt("Publish key", hide_input=True)
    subscribe_key = subscribe_key or typer.prompt("Subscribe key", hide_input=True)
    keys.store(cloud, keys.typed(publish_key, subscribe_key))
    _out.print("stored; Lambda 1 uses them from its next cold start on")
