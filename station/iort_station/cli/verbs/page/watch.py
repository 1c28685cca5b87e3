"""`iort watch`: every car in the terminal, live."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from iort_contract.catalog.derived import Vehicle
from iort_contract.limits import ContractError
from iort_contract.messages.live import decode_live_update
from iort_contract.tables import ROBOT, T_US
from iort_station.cli.console import Console
from iort_station.cli.progress import say
from iort_station.fleet import registry
from iort_station.page import keys
from iort_station.page.listener import Listener
from iort_station.page.watch import FleetWatch

commands = typer.Typer()
_REFRESH_S = 0.25


@commands.command("watch")
def watch(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="A line of JSON for every update.")] = False,
    seconds: Annotated[float | None, typer.Option(min=0, help="Stop after so long; never otherwise.")] = None,
    token: Annotated[
        str, typer.Option(envvar="PUBNUB_ACCESS_TOKEN", help="PubNub's access token to read with.")
    ] = "",
) -> None:
    """Show every car in the terminal, live, until Ctrl-C."""
    cloud = context.obj.cloud()
    pubnub_keys = keys.load(cloud)
    vehicles = {robot: Vehicle(**car) for robot, car in registry.vehicles(cloud).items()}
    fleet, done = FleetWatch(vehicles), threading.Event()
    listener = Listener(
        robot=None,
        namespace=cloud.namespace,
        on_update=_Lines(done).take if as_json else fleet.take,
        token=token,
        **pubnub_keys.reading(),
    )
    try:
        with listener:
            if as_json:
                say(f"listening to {cloud.namespace}.*")
                done.wait(seconds)
            else:
                _show(fleet, seconds, cloud.namespace)
    except KeyboardInterrupt:
        return


class _Lines:
    """Writes a line an update, until nobody reads them any more."""

    def __init__(self, done: threading.Event) -> None:
        self._done = done

    def take(self, update: Any, _pubnub_us: int, now_us: int) -> None:
        try:
            heard = decode_live_update(update)
        except ContractError as error:
            say(f"an invalid update: {error}")
            return
        live = heard.live
        delay_ms = (now_us - live.sent_us - (live.offset_us or 0)) / 1000
        line = {ROBOT: heard.robot, "stream": heard.stream, T_US: live.t_us, "delay_ms": delay_ms}
        try:
            print(json.dumps({**line, "sample": live.sample}), flush=True)
        except BrokenPipeError:
            # Python would complain once more at its end, when it flushes.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            self._done.set()


def _show(fleet: FleetWatch, seconds: float | None, namespace: str) -> None:
    console = Console()
    end = None if seconds is None else time.monotonic() + seconds
    tick = threading.Event()
    with Live(console=console, auto_refresh=False, transient=False) as live:
        while end is None or time.monotonic() < end:
            cars = fleet.cars()
            words = (
                f"{len(cars)} {'car' if len(cars) == 1 else 'cars'}. Ctrl-C stops."
                if cars
                else f"waiting for a car on {namespace}.* (Ctrl-C stops)"
            )
            if fleet.refused:
                words += f" {fleet.refused} malformed updates."
            live.update(
                Group(fleet.table(time.time_ns() // 1000, console.width), Text(words, style="dim")),
                refresh=True,
            )
            tick.wait(_REFRESH_S)
