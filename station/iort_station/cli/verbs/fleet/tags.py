"""`iort robots tag`: what the fleet's view groups and finds robots by."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import out, print_json
from iort_station.cli.options import AsJson, Robot
from iort_station.cli.words import examples
from iort_station.errors import UsageError
from iort_station.fleet import robots

commands = typer.Typer()


@commands.command(
    "tag", epilog=examples("robots tag car7 lab=north team=blue", "robots tag car7 --remove team")
)
def tag(
    context: typer.Context,
    name: Robot,
    changes: Annotated[
        list[str] | None,
        typer.Argument(metavar="TAG=VALUE", help="Tags to set, for example lab=north team=blue."),
    ] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to remove; may be repeated.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show or change a robot's tags. The page finds and groups robots by them."""
    wanted = {**dict(map(_change, changes or [])), **dict.fromkeys(remove or [])}
    now = robots.change_tags(context.obj.cloud(), name, wanted)
    if as_json:
        print_json({"robot": name, "tags": now})
        return
    for key, value in now.items():
        out.print(f"{key}={value}", soft_wrap=True)


def _change(text: str) -> tuple[str, str | None]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise UsageError(f"must be TAG=VALUE, for example lab=north, got {text}")
    return name, value
