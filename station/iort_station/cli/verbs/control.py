"""`iort send`, `stop`, `config` and `ask`: commands, the emergency stop, settings, and questions."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.catalog.questions import QUESTIONS
from iort_contract.checks import json_object
from iort_contract.limits import ContractError
from iort_contract.messages.commands import DRIVE_LEASE_MS, MAX_LEASE_MS, MAX_VALID_MS
from iort_contract.messages.page import RobotPresence
from iort_contract.messages.shadow import Rejection
from iort_contract.tables import ONLINE
from iort_contract.topics import ACCEPTED
from iort_station.cli import options
from iort_station.cli.console import Lines, errors, out, print_json, tell
from iort_station.cli.options import AsJson, Blind, CloudOptions, Robot, argument, examples, option, say
from iort_station.cloud import Cloud
from iort_station.errors import StationError, UsageError
from iort_station.fleet import control, registry, stopping
from iort_station.fleet.control import Shadow, State
from iort_station.fleet.stopping import Motion
from iort_station.operations import alarms
from iort_station.output import one_line
from iort_station.times import iso_s

commands = typer.Typer()


@commands.command("send", epilog=examples("""send car7 drive '{"drive": {"speed": 1.0}}' --lease-ms 500"""))
def send(
    context: typer.Context,
    robot: Robot,
    name: Annotated[str, argument("The command: a key of downlink.cmd in the robot's car.yaml.")],
    message: Annotated[str, argument("The ROS message as JSON, with the fields of its type.")],
    lease_ms: Annotated[
        int | None,
        option("How long the robot may move, from now; needed if it moves.", min=1, max=MAX_LEASE_MS),
    ] = None,
    valid_ms: Annotated[
        int, option("The robot rejects it if it arrives later than this.", min=1, max=MAX_VALID_MS)
    ] = control.VALID_MS,
    seconds: Annotated[float, option("How long to wait for the robot's answer.", min=0)] = control.ANSWER_S,
    takeover: Annotated[
        bool, option("Take the wheel from whoever drives; refused otherwise.", "--takeover")
    ] = False,
    blind: Blind = False,
    as_json: AsJson = False,
) -> None:
    """Send a command and print the robot's answer.

    Exit status 1 if the robot rejects it or does not answer. Every call is an operator's session of its own:
    while another one drives, also an earlier call of yours, a motion is refused unless it has --takeover.
    """
    asked = _message(message)
    cloud = context.obj.cloud()
    with errors.status(f"waiting for {robot}"):
        command, said, offline = control.send(
            cloud,
            robot,
            name,
            asked,
            lease_ms=lease_ms,
            valid_ms=valid_ms,
            seconds=seconds,
            takeover=takeover,
            blind=blind,
            on_offline=say,
        )
    if as_json:
        sent = {"robot": robot, "command": name, "session": command.session, "seq": command.seq}
        print_json({**sent, "outcome": said})
    elif said == ACCEPTED:
        out.print(f"{robot} has accepted {name}")
    if offline:
        raise StationError(f"{offline}, and has not answered")
    if said is None:
        raise StationError(
            f"{robot} has not answered within {seconds:g} s: is its agent running, and has its car.yaml "
            f"downlink.cmd.{name}?"
        )
    if said != ACCEPTED:
        advice = control.advice(said)
        raise StationError(f"{robot} has rejected {name}: {one_line(said)}{advice and f': {advice}'}")


def _message(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text)
    except ValueError as error:
        raise UsageError(f"MESSAGE must be JSON, got {text}: {error}") from error
    if not isinstance(message, dict):
        raise UsageError(f"MESSAGE must be a JSON object with the ROS message's fields, got {text}")
    return message


# A stop waits for nothing that reads: it has clients of its own, which give up within seconds, and robots
# that are named are stopped before anything is looked up.

_POLL_S, _AGAIN_S = 0.1, 2.0
# A robot that is connected answers sooner, and so does the registry.
_SOON_S, _LOOK_S = 1.0, 0.5
_ELSEWHERE = (
    f"By itself ends what a stick drives, {DRIVE_LEASE_MS / 1000:g} s after the last command that the car "
    f"got, and what `iort send` moves, at the end of its lease: {MAX_LEASE_MS / 1000:g} s at most. A planner "
    "on board drives on: use the switch at the car."
)


@commands.command("stop", epilog=examples("stop car7", "stop car7 --release", "stop --all --release"))
def stop(
    context: typer.Context,
    robots: Annotated[list[str] | None, argument("The robots' names.", autocompletion=options.robots)] = None,
    everyone: Annotated[bool, option("Every robot of the registry.", "--all")] = False,
    release: Annotated[bool, option("Let them move again.", "--release")] = False,
    seconds: Annotated[float, option("How long to wait for the robots.", min=0)] = 10.0,
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
    lookup = _Lookup(cloud, sent, presence)
    # Words may wait for the registry, and the stop itself never does.
    lookup.known.wait(_LOOK_S)
    strangers = dict(lookup.strangers)
    for why in strangers.values():
        say(why)
    if heard := [name for name in sent if name not in strangers]:
        say(f"{'release' if release else 'stop'} sent to {', '.join(heard)}")
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
    does not answer. ``strangers`` has the names that nobody registered, whose stop is taken back: they are
    ``known`` first. ``away`` has those that are not connected."""

    def __init__(self, cloud: Cloud, names: list[str], presence: Mapping[str, RobotPresence]) -> None:
        super().__init__(daemon=True)
        self._cloud, self._names = cloud, names
        self.strangers: dict[str, str] = {}
        self.known = threading.Event()
        self.away = {name for name in names if name in presence and not presence[name]["online"]}
        if presence:
            self.known.set()
        else:
            self.start()

    def run(self) -> None:
        self.strangers = stopping.take_back(self._cloud, self._names)
        self.known.set()
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


# `iort config`: read and change the settings of a running agent.


@commands.command(
    "config", epilog=examples("config car7", "config car7 live.rate_hz=5 fields.vesc=speed,fault_code")
)
def config(
    context: typer.Context,
    robot: Robot,
    changes: Annotated[
        list[str] | None,
        argument("live.rate_hz=5, fields.vesc=speed,fault_code, log_level=debug", metavar="[NAME=VALUE]..."),
    ] = None,
    unset: Annotated[
        list[str] | None, option("A setting to withdraw; car.yaml's value applies again.")
    ] = None,
    seconds: Annotated[float, option("How long to wait for the robot's answer.", min=0.1)] = 30.0,
    as_json: AsJson = False,
) -> None:
    """Show a robot's settings, or change them and wait for its answer.

    A value that no agent accepts is not sent. A change that the robot rejects is withdrawn: the last accepted
    value stays in force, and the exit status is 1. A change for an offline robot is pending until it is back.
    """
    wanted = {**dict(map(_change, changes or [])), **dict.fromkeys(unset or [])}
    cloud = context.obj.cloud()
    if not wanted:
        state = Shadow(cloud, robot).read()
        rejected = state.rejected()
        _print(robot, state, rejected, {}, as_json=as_json)
        if rejected and not as_json:
            unsets = " ".join(f"--unset {name}" for name in rejected)
            errors.print(f"`iort config {robot} {unsets}` withdraws what is rejected", soft_wrap=True)
        return
    with errors.status(f"waiting for {robot}"):
        state, rejected, online, answer = control.change_settings(cloud, robot, wanted, seconds)
    _print(robot, state, rejected, wanted, as_json=as_json)
    pending = state.pending().keys() & wanted.keys()
    if not answer and online:
        raise StationError(
            f"{robot} is online and has not answered within {seconds:g} s: is its agent running? "
            "The change is pending; --unset withdraws it"
        )
    if pending and not as_json:
        errors.print(f"pending: {robot} is offline, and applies it when it is back", soft_wrap=True)
    if rejected:
        raise typer.Exit(1)


def _change(text: str) -> tuple[str, Any]:
    name, value = options.assigned(text, "live.rate_hz=5")
    return name, control.parse_setting(name, value)


def _print(
    robot: str, state: State, rejected: Mapping[str, Rejection], wanted: Mapping[str, Any], *, as_json: bool
) -> None:
    in_force, pending = state.reported.settings, state.pending()
    if as_json:
        reasons = {name: one._asdict() for name, one in rejected.items()}
        print_json({"robot": robot, "settings": in_force, "rejected": reasons, "pending": pending})
        return
    if not in_force:
        out.print(f"{robot} has reported no settings yet")
    said = {name: "  (withdrawn)" if value is None else "  (changed)" for name, value in wanted.items()}
    said |= dict.fromkeys(rejected, "  (unchanged: the change is rejected)")
    said |= {name: f"  (pending: {control.setting_text(value)})" for name, value in pending.items()}
    for name, value in {**dict.fromkeys(pending, "?"), **in_force}.items():
        out.print(f"{name}={control.setting_text(value)}{said.get(name, '')}")
    for one in rejected.values():
        errors.print(f"rejected: {one.reason}", style="red")


# `iort ask`: a robot's question to the cloud, asked by the operator.


@commands.command("ask", epilog=examples("ask car7 calibration", "ask car7 raceline --body track.json"))
def ask(
    context: typer.Context,
    robot: Robot,
    question: Annotated[str, argument(f"One of {', '.join(QUESTIONS)}.")],
    body: Annotated[Path | None, option("A JSON file with the body of the question.")] = None,
    as_json: AsJson = False,
) -> None:
    """Ask the cloud what a robot may ask, and print the answer: indented, or as one line of JSON.

    It takes nothing from the robot's quota. Exit status 1 if the cloud refuses, with the reason.
    """
    asked = {} if body is None else _read(body)
    cloud = context.obj.cloud()
    with errors.status(f"waiting for {question} of {robot}"):
        answer = control.ask(cloud, robot, question, asked)
    tell(answer, Lines(json.dumps(answer, indent=2)), as_json=as_json)


def _read(file: Path) -> dict[str, Any]:
    try:
        return json_object(file.read_bytes(), str(file))
    except (ContractError, OSError) as error:
        raise UsageError(str(error)) from error
