"""`iort stop`: the emergency stop of one robot or all, and its release.

A stop waits for nothing that reads: it has clients of its own, which give up within seconds, and robots that
are named are stopped before anything is looked up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Annotated, NoReturn

import typer
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.messages.commands import DRIVE_LEASE_MS, MAX_LEASE_MS
from iort_contract.messages.page import RobotPresence
from iort_contract.tables import ONLINE
from iort_station.cli import completion
from iort_station.cli.cloud_options import CloudOptions
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson
from iort_station.cli.words import examples, say
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import registry, stopping
from iort_station.fleet.stopping import Motion
from iort_station.operations import alarms
from iort_station.times import iso_s

commands = typer.Typer()
_POLL_S, _AGAIN_S = 0.1, 2.0
# A robot that is connected answers sooner.
_SOON_S = 1.0
_ELSEWHERE = (
    f"By itself ends what a stick drives, {DRIVE_LEASE_MS / 1000:g} s after the last command that the car "
    f"got, and what `iort send` moves, at the end of its lease: {MAX_LEASE_MS / 1000:g} s at most. A planner "
    "on board drives on: use the switch at the car."
)


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
    One that is not connected does so before it takes a command again. One whose car.yaml has no command with
    motion cannot be stopped: `iort robots list` shows it. --all --release releases what a stop of
    all has stopped: a robot that was also stopped by its name stays. Exit status 1 unless every robot that is
    connected has confirmed it.
    """
    if bool(robots) == everyone:
        raise UsageError("give the robots' names, or --all")
    try:
        cloud = _cloud(context.obj)
        presence = registry.presence(cloud) if everyone else {}
        names = sorted(presence) if everyone else list(dict.fromkeys(robots or []))
        failed = _ask(cloud, names, everyone=everyone, release=release)
    except (StationError, BotoCoreError, ClientError) as error:
        _not_done(str(error), release=release, everyone=everyone)
    sent = [name for name in names if name not in failed]
    if names and not sent:
        _not_done("; ".join(f"{name}: {why}" for name, why in failed.items()), release=release)
    if sent:
        say(f"{'release' if release else 'stop'} sent to {', '.join(sent)}")
    lookup = _Lookup(cloud, sent, presence)
    answers = dict.fromkeys(names) | _wait(cloud, lookup, sent, seconds, release=release, everyone=everyone)
    failed |= lookup.strangers
    stays = {name for name, one in answers.items() if everyone and release and one and one.alone}
    online = [name for name in sent if name not in {*failed, *stays, *lookup.away}]
    words = {
        name: _failed(failed[name], release=release)
        if name in failed
        else _words(one, stopped=not release, stays=name in stays, online=name in online)
        for name, one in answers.items()
    }
    done = {name for name, one in answers.items() if name not in failed and _done(one, stopped=not release)}
    if as_json:
        print_json({name: _facts(answers[name], text) for name, text in words.items()})
    else:
        for name in sorted(words, key=lambda name: name in done):
            style = None if name in done or release else "bold red"
            out.print(f"{name}: {words[name]}", style=style, soft_wrap=True)
    if not names:
        say("no robot is registered")
    if not release and (moving := [name for name in names if name not in done]):
        say(f"NOT known to stand: {', '.join(moving)}. {_ELSEWHERE}")
    if failed or not done.issuperset(online):
        raise StationError("not every robot has confirmed it")


def _cloud(options: CloudOptions) -> Cloud:
    cloud: Cloud = options.cloud().urgent()
    return cloud


def _ask(cloud: Cloud, names: list[str], *, everyone: bool, release: bool) -> dict[str, str]:
    by = alarms.user()
    if not release:
        return stopping.stop(cloud, names, by=by, fleet=everyone)
    return stopping.release(cloud, names, by=by, fleet=everyone)


def _not_done(why: str, *, release: bool, everyone: bool = False) -> NoReturn:
    """End with what did not happen, what happens without it, and only then why."""
    if release:
        raise StationError(f"NOTHING WAS RELEASED: {why}")
    named = ["A stop by names needs no list of the robots: `iort stop NAME`."] if everyone else []
    raise StationError("NOTHING WAS STOPPED.", _ELSEWHERE, *named, f"The cloud: {why}")


def _motion(cloud: Cloud, names: Iterable[str]) -> dict[str, Motion | None]:
    """What each robot has said; nothing while it cannot be read."""
    try:
        return dict(stopping.motion(cloud, names))
    except (StationError, BotoCoreError, ClientError):
        return {}


class _Lookup(threading.Thread):
    """What the registry knows of robots that were stopped, while they answer: nothing waits for it but who
    does not answer. ``strangers`` has the names that nobody registered, whose stop is taken back; ``away``
    those that are not connected."""

    def __init__(self, cloud: Cloud, names: list[str], presence: Mapping[str, RobotPresence]) -> None:
        super().__init__(daemon=True)
        self._cloud, self._names = cloud, names
        self.strangers: dict[str, str] = {}
        self.away = {name for name in names if name in presence and not presence[name]["online"]}
        if not presence:
            self.start()

    def run(self) -> None:
        self.strangers = stopping.take_back(self._cloud, self._names)
        for name in self._names:
            with suppress(StationError, BotoCoreError, ClientError):
                if name not in self.strangers and not registry.get(self._cloud, name).get(ONLINE):
                    self.away.add(name)


def _wait(
    cloud: Cloud, lookup: _Lookup, names: list[str], seconds: float, *, release: bool, everyone: bool
) -> dict[str, Motion | None]:
    """What the robots have said once each that can has answered, or after so many seconds."""
    began = time.monotonic()
    again, warned = began + _AGAIN_S, False
    with errors.status("waiting for the robots"):
        while True:
            answers = _motion(cloud, names)
            waits = [
                name
                for name in names
                if name not in {*lookup.away, *lookup.strangers}
                and _pending(answers.get(name), release=release, everyone=everyone)
            ]
            now = time.monotonic()
            if not waits or now - began > seconds:
                return answers
            if not release and not warned and now - began > _SOON_S:
                warned = True
                say(f"no answer after {_SOON_S:g} s from {', '.join(waits)}. {_ELSEWHERE}")
            if now > again:
                # A robot that has missed the change learns from the next one that it has.
                stopping.repeat(cloud, waits)
                again += _AGAIN_S
            # A shadow sends no events to this API.
            time.sleep(_POLL_S)


def _pending(one: Motion | None, *, release: bool, everyone: bool) -> bool:
    """Whether an answer can still come."""
    if one is None:
        return True
    over = one.alone and everyone if release else one.stoppable is False
    return not (one.reason or over or _done(one, stopped=not release))


def _done(one: Motion | None, *, stopped: bool) -> bool:
    return one is not None and (one.stands if stopped else not one.stopped)


def _by(one: Motion | None) -> str:
    return f"{one.by.by} at {iso_s(one.by.t_ms * 1000)}" if one is not None and one.by is not None else ""


def _facts(one: Motion | None, text: str) -> dict[str, object]:
    said = None if one is None else one.stopped
    return {"stopped": said, "stands": one is not None and one.stands, "text": text, "by": _by(one)}


def _failed(why: str, *, release: bool) -> str:
    return f"{'not released' if release else 'NOT STOPPED'}: {why}"


def _words(one: Motion | None, *, stopped: bool, stays: bool, online: bool) -> str:
    if stays:
        return f"stays stopped, by {_by(one) or 'somebody'}: release it by its name"
    if one is not None and one.stoppable is False:
        return f"NOT STOPPED: {one.why_not}" if stopped else f"was not stopped: {one.why_not}"
    if one is not None and one.reason:
        return f"NOT STOPPED: {one.reason}" if stopped else f"not released: {one.reason}"
    if _done(one, stopped=stopped):
        return "stopped" if stopped else "released"
    if not stopped:
        return "not confirmed: it is released when it is connected"
    where = "it has not answered" if online else "it is not connected"
    return f"NOT CONFIRMED: {where}, and stops when it hears it, before it takes a command"
