"""`iort watch` and `trace`: every car in the terminal, live, and the delay of what is heard."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from dataclasses import asdict
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from iort_contract.catalog.derived import Vehicle
from iort_contract.catalog.streams import RTT_STREAM
from iort_contract.catalog.vesc import VESC_STREAM
from iort_contract.cloud import IOT, PUBNUB
from iort_contract.limits import LIVE_MAX_RATE_HZ, LIVE_MIN_RATE_HZ, ContractError
from iort_contract.messages.live import decode_live_update
from iort_contract.page import PUBNUB_ORIGIN
from iort_contract.tables import ROBOT, T_US
from iort_station.cli import options
from iort_station.cli.console import errors, out, table, tell
from iort_station.cli.options import AsJson, LiveWay, Robot, Token, examples, option, say
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import registry, viewing
from iort_station.fleet.roles import transport
from iort_station.fleet.viewing import Viewer
from iort_station.operations import audit, trace
from iort_station.page.listening import listening
from iort_station.page.live import FleetWatch, problem
from iort_station.page.page import load_keys
from iort_station.times import iso

commands = typer.Typer()
_REFRESH_S = 0.25
# No more than the terminal shows.
_RATE_HZ = 1 / _REFRESH_S


@commands.command("watch", epilog=examples("watch", "watch --json --seconds 5"))
def watch(
    context: typer.Context,
    as_json: Annotated[bool, option("Print a line of JSON for every update.", "--json")] = False,
    seconds: Annotated[float | None, option("Stop after this time. Default: never.", min=0)] = None,
    rate: Annotated[
        float, option("Updates a second to ask of each stream.", min=LIVE_MIN_RATE_HZ, max=LIVE_MAX_RATE_HZ)
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
            cars_table = fleet.table(time.time_ns() // 1000, out.width)
            live.update(Group(cars_table, Text(words, style="dim")), refresh=True)
            tick.wait(_REFRESH_S)


# `iort trace`: the delay of live updates, hop by hop.


@commands.command("trace", epilog=examples("trace car7 --updates 20"))
def trace_(
    context: typer.Context,
    robot: Robot,
    stream: Annotated[
        str, option("The stream whose live updates to follow.", autocompletion=options.streams)
    ] = VESC_STREAM,
    updates: Annotated[int, option("How many updates to wait for.", min=1)] = 50,
    seconds: Annotated[float, option("How long to wait for them at most.", min=0.1)] = 15.0,
    live: LiveWay = None,
    as_json: AsJson = False,
) -> None:
    """Measure the delay of a robot's live updates, hop by hop, from the sample in the car to this machine."""
    cloud = context.obj.cloud()
    registry.get(cloud, robot)
    found: list[trace.Times] = []
    enough = threading.Event()

    def take(update: dict[str, Any], pubnub_us: int, here_us: int) -> None:
        if update.get("stream") == stream and not enough.is_set():
            found.append(trace.times(update, pubnub_us, here_us))
            if len(found) >= updates:
                enough.set()

    way = live or transport(cloud)
    viewer = Viewer(cloud, [robot], broker=way == IOT)
    with listening(cloud, way, robot=robot, on_update=take), viewer, errors.status(f"listening to {robot}"):
        here_to_pubnub = _pubnub_clock(cloud) if way == PUBNUB else None
        enough.wait(seconds)
    if not found:
        raise StationError(
            f"no update of {robot}'s stream {stream} arrived in {seconds:g} s: "
            f"is it driving, and is its live lane on? {viewer.problem}".rstrip()
        )
    result = trace.trace(
        found,
        here_to_pubnub=here_to_pubnub,
        car_uncertainty_ms=audit.last_figures(cloud, robot).get("clock_uncertainty_ms"),
        newest_rtt=audit.last_batch(cloud, robot, RTT_STREAM),
    )
    tell(asdict(result), lambda: _show_trace(robot, result), as_json=as_json, indented=True)


def _pubnub_clock(cloud: Cloud) -> trace.ClockOffset:
    pubnub = load_keys(cloud)
    with trace.pubnub_clock(pubnub.origin or PUBNUB_ORIGIN, tls=pubnub.tls) as ask:
        return trace.clock_of(ask, lambda: time.time_ns() // 1000)


def _show_trace(robot: str, result: trace.Trace) -> None:
    shown = table(
        "hop", "median", "95 %", "clocks", left=("hop",), title=f"{robot}: {result.updates} live updates"
    )
    for hop in result.hops:
        shown.add_row(*_cells(hop))
    shown.add_row(*_cells(result.whole), style="bold")
    out.print(shown)
    out.print("clocks: the uncertainty of a hop; ? if two providers' clocks are compared without correction")
    if result.round_trips_ms:
        trips = ", ".join(f"{path} {value:.1f} ms" for path, value in result.round_trips_ms.items())
        out.print(f"round trips that the car measured last: {trips}")


def _cells(hop: trace.Hop) -> tuple[str, ...]:
    clocks = "?" if hop.uncertainty_ms is None else f"± {hop.uncertainty_ms:.1f} ms"
    exact = "exact" if hop.uncertainty_ms == 0 else clocks
    return hop.name, f"{hop.p50_ms:.1f} ms", f"{hop.p95_ms:.1f} ms", exact
