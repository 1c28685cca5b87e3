"""`iort pubnub`: the keys that Lambda 1 publishes with."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import AsJson
from iort_station.cli.words import examples
from iort_station.errors import StationError
from iort_station.page.page import store_keys, typed_keys

commands = typer.Typer()


@commands.command("pubnub", epilog=examples("pubnub"))
def pubnub(
    context: typer.Context,
    publish_key: Annotated[
        str | None, typer.Option(envvar="PUBNUB_PUBLISH_KEY", help="The publish key. Default: asks for it.")
    ] = None,
    subscribe_key: Annotated[
        str | None,
        typer.Option(envvar="PUBNUB_SUBSCRIBE_KEY", help="The subscribe key. Default: asks for it."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Store PubNub's keys, encrypted, where Lambda 1 reads them."""
    # Fails for a missing cloud before anybody types a key.
    cloud = context.obj.cloud()
    if cloud.endpoint_url:
        raise StationError("the embedded cloud has a stand-in for PubNub, with its own keys")
    publish_key = publish_key or typer.prompt("Publish key", hide_input=True)
    subscribe_key = subscribe_key or typer.prompt("Subscribe key", hide_input=True)
    store_keys(cloud, typed_keys(publish_key, subscribe_key))
    tell({"stored": True}, "stored; Lambda 1 uses them after its next cold start", as_json=as_json)
