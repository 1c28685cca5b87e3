"""The command `iort`: register robots, store PubNub's keys, serve the live page."""

from __future__ import annotations

import json
import os
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer
from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console

from contract import DEFAULT_NAMESPACE, ROBOT
from station import keys, robots
from station.cloud import EMBEDDED, Cloud
from station.errors import StationError
from station.page import PageServer

app = typer.Typer(no_args_is_help=True, add_completion=True, help="The operator's station of iort.")
robots_app = typer.Typer(no_args_is_help=True, help="The robots that may connect.")
app.add_typer(robots_app, name="robots")
# Whoever has set one of these means an AWS account.
_AWS_NAMED = ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_ACCESS_KEY_ID")
_out = Console(highlight=False)


@dataclass
class _Where:
    """Which cloud the options before the command name."""

    namespace: str
    profile: str | None
    region: str | None
    local: bool
    embedded: Path

    def cloud(self) -> Cloud:
        said = self.profile or self.region or any(os.environ.get(name) for name in _AWS_NAMED)
        if self.local or (not said and self.embedded.exists()):
            if not self.local:
                print("iort: on the embedded cloud that runs in this checkout", file=sys.stderr)  # noqa: T201
            return Cloud.load(self.embedded)
        return Cloud(namespace=self.namespace, profile=self.profile, region=self.region)


@app.callback()
def _where(
    context: typer.Context,
    namespace: Annotated[str, typer.Option(help="The deployment's namespace.")] = DEFAULT_NAMESPACE,
    profile: Annotated[str | None, typer.Option(help="AWS profile.")] = None,
    region: Annotated[str | None, typer.Option(help="AWS region.")] = None,
    local: Annotated[
        bool,
        typer.Option(
            "--local", help="The embedded cloud; also meant when one runs and no AWS option is given."
        ),
    ] = False,
    embedded: Annotated[
        Path, typer.Option(help="The file in which an embedded cloud says how to reach it.")
    ] = EMBEDDED,
) -> None:
    context.obj = _Where(namespace, profile, region, local, embedded)


@robots_app.command("add")
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


@robots_app.command("claim")
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


@robots_app.command("list")
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


@robots_app.command("remove")
def remove(context: typer.Context, name: str) -> None:
    """Revoke a robot's certificates and forget it. What it has sent stays."""
    robots.remove(context.obj.cloud(), name)
    _out.print(f"{name} is removed")


@app.command("pubnub")
def pubnub(
    context: typer.Context,
    publish_key: Annotated[str, typer.Option(prompt=True, hide_input=True, envvar="PUBNUB_PUBLISH_KEY")],
    subscribe_key: Annotated[str, typer.Option(prompt=True, hide_input=True, envvar="PUBNUB_SUBSCRIBE_KEY")],
) -> None:
    """Store PubNub's keys, encrypted, where Lambda 1 reads them."""
    keys.store(context.obj.cloud(), keys.PubNubKeys(publish_key=publish_key, subscribe_key=subscribe_key))
    _out.print("stored; Lambda 1 uses them from its next cold start on")


@app.command("dashboard")
def dashboard(
    context: typer.Context,
    port: Annotated[int, typer.Option(help="The page's port; 0 for a free one.")] = 8080,
    host: Annotated[str, typer.Option(help="The address to listen on.")] = "127.0.0.1",
) -> None:
    """Serve the live page until Ctrl-C."""
    cloud = context.obj.cloud()
    pubnub_keys = keys.load(cloud)
    vehicles = {
        str(row[ROBOT]): {"speed_to_erpm_gain": float(row["speed_to_erpm_gain"])}
        for row in robots.listed(cloud)
        if row.get("speed_to_erpm_gain")
    }
    with PageServer(
        namespace=cloud.namespace,
        subscribe_key=pubnub_keys.subscribe_key,
        vehicles=vehicles,
        host=host,
        port=port,
        **pubnub_keys.server(),
    ) as page:
        _out.print(f"{page.url}  (Ctrl-C stops)")
        threading.Event().wait()


def main() -> None:
    """Run the command; an error that is expected is one line on standard error, and status 1."""
    try:
        app()
    except StationError as error:
        sys.exit(f"iort: {error}")
    except (BotoCoreError, ClientError) as error:
        sys.exit(f"iort: AWS refused a call: {error}")
    except OSError as error:
        sys.exit(f"iort: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
