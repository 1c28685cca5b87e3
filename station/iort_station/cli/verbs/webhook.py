"""`iort webhook`: where the cloud tells of incidents, signed."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, Yes, agreed, examples
from iort_station.errors import StationError
from iort_station.operations.webhook import remove, send_test, store, stored

commands = typer.Typer(
    name="webhook", no_args_is_help=True, help="Send incidents to a program of yours, signed."
)


@commands.command("set", epilog=examples("webhook set https://lab.example.org/incidents"))
def set_(
    context: typer.Context,
    url: Annotated[str, typer.Argument(metavar="URL", help="The receiver's address, by https.")],
    as_json: AsJson = False,
) -> None:
    """Store the receiver's address with a new secret, which is printed once. The one before stops working."""
    made = store(context.obj.cloud(), url)
    text = f"stored; the cloud uses it at once. The receiver's secret, shown only now:\n{made.secret}"
    tell({"url": made.url, "secret": made.secret}, text, as_json=as_json)


@commands.command("show", epilog=examples("webhook show"))
def show(context: typer.Context, as_json: AsJson = False) -> None:
    """Print the receiver's address, without its secret."""
    known = stored(context.obj.cloud())
    text = "no webhook" if known is None else known.url
    tell({"url": None if known is None else known.url}, text, as_json=as_json)


@commands.command("test", epilog=examples("webhook test"))
def send(context: typer.Context, as_json: AsJson = False) -> None:
    """Have the cloud send a signed test message now. Exit status 1 if the receiver does not take it."""
    status = send_test(context.obj.cloud())
    tell({"status": status}, f"the receiver took it: {status}", as_json=as_json)


@commands.command("remove", epilog=examples("webhook remove"))
def remove_(context: typer.Context, yes: Yes = False, as_json: AsJson = False) -> None:
    """Remove address and secret: no program hears of incidents."""
    cloud = context.obj.cloud()
    agreed(f"Remove the webhook of the deployment {cloud.namespace}?", yes=yes)
    if not remove(cloud):
        raise StationError("there is no webhook")
    tell({"removed": True}, "removed; the cloud sends no more", as_json=as_json)
