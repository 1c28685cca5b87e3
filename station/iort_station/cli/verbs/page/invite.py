"""`iort invite`: a link for one more browser."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station import kept
from iort_station.cli.console import tell
from iort_station.cli.options import AsJson
from iort_station.cli.words import examples
from iort_station.page import invitations

commands = typer.Typer()


@commands.command("invite", epilog=examples("invite", "invite --port 8080"))
def invite(
    port: Annotated[
        int | None, typer.Option(help="The page's port, if you serve several. Default: the only one.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print a new link to the page that you serve. The first browser that opens it may stop and drive."""
    page, address = invitations.invite(kept.pages(), port)
    tell({"url": page.url, "address": address}, address, as_json=as_json)
