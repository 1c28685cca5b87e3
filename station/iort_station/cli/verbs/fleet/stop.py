"""`iort stop`: the emergency stop of one robot or all, and its release."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from iort_station.cli import completion
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson
from iort_station.cli.words import examples, say
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry
from iort_station.fleet.control import stopping
from iort_station.fleet.control.stopping import Motion
from iort_station.operations.monitoring import alarms
from iort_station.times import iso_s

commands = typer.Typer()
_POLL_S, _AGAIN_S = 0.3, 2.0


@commands.command("stop", epilog=examples("stop car7", "stop car7 --release", "stop --all --release"))
def stop(
    context: typer.Context,
    robots: Annotated[
        list[str] | None, typer.Argument(help="The robots' names.", autocompletion=completion.robots)
    ] = None,
    everyone: Annotated[bool, typer.Option("--all", help="Every robot of the registry.")] = False,
    release: Annotated[bool, typer.Option("--release", help="Let them move again.")] = False,
    seconds: Annotated[float, typer.Option(min=0, help="How long to wait for the robots.")] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Stop robots in an emergency, until --release.

    A robot ends every motion by command at once and refuses new ones, also after it or the cloud restarts.
    One that is not connected does so before it takes a command again. --all --release releases what a stop of
    all has stopped: a robot that was also stopped by its name stays. Exit status 1 unless every robot that is
    connected has confirmed it.
    """
    if bool(robots) == everyone:
        raise UsageError("give the robots' names, or --all")
    cloud = context.obj.cloud()
    presence = registry.presence(cloud)
    names = sorted(presence) if everyone else list(dict.fromkeys(robots or []))
    failed = _ask(cloud, names, everyone=everyone, release=release)
    stays = stopping.motion(cloud, names) if everyone and release else {}
    stays = {name: one for name, one in stays.items() if one.alone}
    online = [name for name in names if name not in {**failed, **stays} and presence[name]["online"]]
    with errors.status("waiting for the robots"):
        found = _wait(cloud, online, seconds, stopped=not release)
    found |= stopping.motion(cloud, [name for name in names if name not in found])
    told = {
        name: failed.get(name) or _told(found[name], stopped=not release, stays=name in stays)
        for name in names
    }
    if as_json:
        print_json(
            {
                name: {"stopped": found[name].stopped, "text": text, "by": _by(found[name])}
                for name, text in told.items()
            }
        )
    else:
        for name, text in told.items():
            out.print(f"{name}: {text}", soft_wrap=True)
    if not names:
        say("no robot is registered")
    if failed or any(not _done(found[name], stopped=not release) for name in online):
        raise StationError("not every robot has confirmed it")


def _ask(cloud: Cloud, names: list[str], *, everyone: bool, release: bool) -> dict[str, str]:
    by = alarms.user()
    if not release:
        return stopping.stop(cloud, names, by=by, fleet=everyone)
    return stopping.release(cloud, names, by=by, fleet=everyone)


def _wait(cloud: Cloud, names: list[str], seconds: float, *, stopped: bool) -> dict[str, Motion]:
    """What the robots have said once each has answered, or after so many seconds."""
    deadline, again = time.monotonic() + seconds, time.monotonic() + _AGAIN_S
    while True:
        found = stopping.motion(cloud, names)
        waits = [name for name, one in found.items() if not one.reason and not _done(one, stopped=stopped)]
        if not waits or time.monotonic() > deadline:
            return found
        if time.monotonic() > again:
            # A robot that has missed the change learns from the next one that it has.
            stopping.repeat(cloud, waits)
            again += _AGAIN_S
        # A shadow sends no events to this API.
        time.sleep(_POLL_S)


def _done(one: Motion, *, stopped: bool) -> bool:
    return bool(one.stopped) is stopped


def _by(one: Motion) -> str:
    return f"{one.by.by} at {iso_s(one.by.t_ms * 1000)}" if one.by is not None else ""


def _told(one: Motion, *, stopped: bool, stays: bool) -> str:
    if stays:
        return f"stays stopped, by {_by(one) or 'somebody'}: release it by its name"
    if one.reason:
        return f"not {'stopped' if stopped else 'released'}: {one.reason}"
    if _done(one, stopped=stopped):
        return "stopped" if stopped else "released"
    return f"not confirmed: it {'stops' if stopped else 'is released'} when it is connected"
