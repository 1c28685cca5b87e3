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
from iort_contract.cloud import IOT
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, ContractError
from iort_contract.messages.live import decode_live_update
from iort_contract.tables import ROBOT, T_US
from iort_station.cli.console import out
from iort_station.cli.options import LiveWay, Token
from iort_station.cli.words import examples, say
from iort_station.fleet import registry, viewing
from iort_station.fleet.roles import transport
from iort_station.page.listening import listening
from iort_station.page.live import FleetWatch, problem
from iort_station.times import iso

commands = typer.Typer()
_REFRESH_S = 0.25
# No more than the terminal shows.
_RATE_HZ = 1 / _REFRESH_S


@commands.command("watch", epilog=examples("watch", "watch --json --seconds 5"))
def watch(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print a line of JSON for every update.")] = False,
    seconds: Annotated[
        float | None, typer.Option(min=0, help="Stop after this time. Default: never.")
    ] = None,
    rate: Annotated[
        float,
        typer.Option(
            min=LIVE_MIN_RATE_HZ, max=LIVE_MAX_RATE_HZ, help="Updates a second to ask of each stream."
        ),
    ] = _RATE_HZ,
    live: LiveWay = None,
    token: Token = "",
) -> None:
    """Show every car in the terminal, live, until Ctrl-C. The cars send at the rate asked for until then."""
    cloud = context.obj.cloud()
    vehicles = {robot: Vehicle(**car) for robot, car in registry.vehicles(cloud).items()}
    fleet, done = FleetWatch(vehicles), threading.Event()
    way = live or transport(cloud)
    listener = listening(
        cloud,
        way,
        on_update=(lambda update, _, now_us: _print_line(update, now_us, done)) if as_json else fleet.take,
        token=token,
    )
    viewer = viewing.Viewer(cloud, lambda: viewing.online(cloud), rate_hz=rate, broker=way == IOT)
    try:
        with listener, viewer:
            if as_json:
                say(f"listening to {cloud.namespace}.*")
                if viewer.problem:
                    say(viewer.problem)
                done.wait(seconds)
            else:
                _show(fleet, viewer, seconds, cloud.namespace)
    except KeyboardInterrupt:
        return


def _print_line(update: Any, now_us: int, done: threading.Event) -> None:
    """Print an update; set ``done`` if nobody reads the output any more."""
    try:
        heard = decode_live_update(update)
    except ContractError as error:
        say(f"a malformed update {problem(update, error)}")
        return
    live = heard.live
    delay_ms = (now_us - live.sent_us - (live.offset_us or 0)) / 1000
    line = {
        ROBOT: heard.robot,
        "stream": heard.stream,
        "time": iso(live.t_us),
        T_US: live.t_us,
        "delay_ms": delay_ms,
    }
    try:
        print(json.dumps({**line, "sample": live.sample}), flush=True)
    except BrokenPipeError:
        # Python flushes at its end, and would complain once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        done.set()


def _show(fleet: FleetWatch, viewer: viewing.Viewer, seconds: float | None, namespace: str) -> None:
    end = None if seconds is None else time.monotonic() + seconds
    tick = threading.Event()
    with Live(console=out, auto_refresh=False, transient=False) as live:
        while end is None or time.monotonic() < end:
            count = len(fleet.cars())
            cars = f"{count} {'car' if count == 1 else 'cars'}. Ctrl-C stops."
            words = cars if count else f"waiting for a car on {namespace}.* (Ctrl-C stops)"
            if fleet.refused:
                words += f" {fleet.refused} malformed updates, the newest {fleet.newest_refused}."
            if viewer.problem:
                words += f" {viewer.problem}"
            table = fleet.table(time.time_ns() // 1000, out.width)
            live.update(Group(table, Text(words, style="dim")), refresh=True)
            tick.wait(_REFRESH_S)
