"""`iort robots`: the robots that may connect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from contract import ROBOT
from station import robots
from station.errors import StationError

commands = typer.Typer(no_args_is_help=True, help="The robots that may connect.")
_out = Console(highlight=False)


@commands.command("add")
def add(
    context: typer.Context,
    name: str,
    out: Annotated[
        Path, typer.Option(help="Where the robot's folder of configuration and keys goes.")
    ] = Path(),
    speed_to_erpm_gain: Annotated[float, typer.Option(help="erpm per m/s (vesc.yaml).")] = 4614.0,
) -> None:
    """Register a robot and write the folder that it needs: car.yaml, certificate and key."""
    vehicle = {**robots.F1TENTH, "speed_to_erpm_gain": speed_to_erpm_gain}
    bundle = robots.add(context.obj.cloud(), name, out=out, vehicle=vehicle)
    _out.print(f"{name} is registered. Copy {bundle.folder} to it, then run there:\n")
    _out.print(f"  iort-agent --config {bundle.folder.name}/car.yaml")


@commands.command("claim")
def claim(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="The robot's name; none for --lasting ones.")] = None,
    out: Annotated[Path, typer.Option(help="The folder to write the claim into.")] = Path("claim"),
    lasting: Annotated[bool, typer.Option(help="Good until revoked, not for five minutes.")] = False,
) -> None:
    """Write a claim, which the robot exchanges for a certificate of its own key's."""
    if name is None and not lasting:
        raise StationError("give the robot's name, or --lasting for a claim of many robots")
    path = robots.claim(context.obj.cloud(), name, out=out, lasting=lasting)
    _out.print(f"Copy {out} to the robot, then run there:\n")
    _out.print(f"  iort-agent provision --config {out.name}/{path.name}")


@commands.command("list")
def list_(
    context: typer.Context, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False
) -> None:
    """List the registered robots and their parameters."""
    rows = sorted(robots.listed(context.obj.cloud()), key=lambda row: str(row[ROBOT]))
    if as_json:
        _out.print_json(json.dumps(rows, default=float))
        return
    for row in rows:
        parameters = ", ".join(f"{key} {value}" for key, value in sorted(row.items()) if key != ROBOT)
        _out.print(f"{row[ROBOT]}  {parameters}")


@commands.command("remove")
def remove(context: typer.Context, name: str) -> None:
    """Revoke a robot's certificates and forget it. What it has sent stays."""
    robots.remove(context.obj.cloud(), name)
    _out.print(f"{name} is removed")
