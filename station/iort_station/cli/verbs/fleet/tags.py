"""`iort robots tag`: what the fleet's view groups and finds robots by."""

from __future__ import annotations

from typing import Annotated

import typer

from iort_station.cli.console import out
from iort_station.errors import UsageError
from iort_station.fleet import tags

commands = typer.Typer()


@commands.command("tag")
def tag(
    context: typer.Context,
    name: str,
    changes: Annotated[
        list[str] | None, typer.Argument(metavar="[TAG=VALUE]...", help="For example lab=north team=blue.")
    ] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to remove; may be repeated.")] = None,
) -> None:
    """Show or change a robot's tags. The page finds and groups robots by them."""
    wanted = {**dict(map(_change, changes or [])), **dict.fromkeys(remove or [])}
    for key, value in tags.change(context.obj.cloud(), name, wanted).items():
        out.print(f"{key}={value}", markup=False, soft_wrap=True)


def _change(text: str) -> tuple[str, str | None]:
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise UsageError(f"must be TAG=VALUE, for example lab=north, got {text}")
    return name, value
