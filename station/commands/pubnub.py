"""`iort pubnub`: the keys that Lambda 1 publishes with."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from station import keys

commands = typer.Typer()
_out = Console(highlight=False)


@commands.command("pubnub")
def pubnub(
    context: typer.Context,
    publish_key: Annotated[str, typer.Option(prompt=True, hide_input=True, envvar="PUBNUB_PUBLISH_KEY")],
    subscribe_key: Annotated[str, typer.Option(prompt=True, hide_input=True, envvar="PUBNUB_SUBSCRIBE_KEY")],
) -> None:
    """Store PubNub's keys, encrypted, where Lambda 1 reads them."""
    keys.store(context.obj.cloud(), keys.PubNubKeys(publish_key=publish_key, subscribe_key=subscribe_key))
    _out.print("stored; Lambda 1 uses them from its next cold start on")
