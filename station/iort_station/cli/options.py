"""The options that several verbs have: each has one name and one meaning, in every verb."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from dataclasses import fields as dataclass_fields
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer
from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.catalog.derived import DERIVED
from iort_station import kept
from iort_station.cloud import AWS_NAMED, Cloud, embedded_here, find_embedded
from iort_station.errors import StationError, UsageError
from iort_station.output import cache, one_line, whole
from iort_station.times import duration_us, has_zone, is_clock, iso_s, time_us
from iort_station.upkeep.snapshot import VERSION

if TYPE_CHECKING:
    from iort_contract.messages.page import Archived

# What TAB offers: the names of robots, streams, fields and files.
#
# The shell waits for TAB, and a cloud takes a second to answer. So names are kept in a file, in the user's
# cache. A process in the background asks the cloud, and writes the file for the next TAB. Only the first TAB
# waits for it. TAB prints no error: an unreachable cloud offers nothing.

# How long names are offered before the cloud is asked again, and how long the first TAB waits.
_FRESH_S, _PATIENCE_S = 30.0, 3.0
_NEWEST_FILES = 200
# Set in the process in the background.
_ASKS = "IORT_COMPLETION_ASKS"
Offer = Callable[[typer.Context, str], list[str]]


def _offer(ask: Callable[[Cloud, str, str], Iterable[str]], *, several: bool = False) -> Offer:
    """What TAB offers: names that ``ask`` gets of the cloud, for the robot and the stream that are named
    before. With ``several``, more may follow after a comma."""

    def offered(ctx: typer.Context, incomplete: str) -> list[str]:
        robot, stream = str(ctx.params.get("robot") or ctx.params.get("name")), str(ctx.params.get("stream"))
        names = _names(ctx, lambda cloud: list(ask(cloud, robot, stream)), ask.__name__, robot, stream)
        before, comma, begun = incomplete.rpartition(",") if several else ("", "", incomplete)
        taken = before.split(",")
        return [f"{before}{comma}{name}" for name in names if name.startswith(begun) and name not in taken]

    return offered


# Only the background asks, so only it imports what this needs.


def _robots(cloud: Cloud, _robot: str, _stream: str) -> Iterable[str]:
    from iort_station.fleet import registry  # noqa: PLC0415 - see above

    return sorted(str(row["robot"]) for row in registry.listed(cloud))


def _streams(cloud: Cloud, robot: str, _stream: str) -> Iterable[str]:
    from iort_station.data import inventory  # noqa: PLC0415 - see above

    return inventory.streams_of(cloud, robot)


def _fields(cloud: Cloud, robot: str, stream: str) -> Iterable[str]:
    from iort_station.data import inventory  # noqa: PLC0415 - see above

    return sorted({*inventory.newest_block(cloud, robot, stream).columns, *DERIVED})


def _files(cloud: Cloud, robot: str, _stream: str) -> Iterable[str]:
    from iort_station.fleet import files  # noqa: PLC0415 - see above

    return list(dict.fromkeys(file.name for file in files.listed(cloud, robot)))[-_NEWEST_FILES:]


robots, streams, files = _offer(_robots), _offer(_streams), _offer(_files)
fields = _offer(_fields, several=True)


def _names(ctx: typer.Context, ask: Callable[[Cloud], list[str]], *key: str) -> list[str]:
    """The names that are kept under ``key``; older ones are asked for in the background."""
    with suppress(Exception):
        given = ctx.find_root().params
        options = CloudOptions(**{each.name: given[each.name] for each in dataclass_fields(CloudOptions)})
        path = _kept_at(options, *key)
        if _ASKS in os.environ:
            _keep(path, ask(options.cloud()))
            return []
        names = _kept(path)
        if not path.exists() or not 0 <= time.time() - path.stat().st_mtime < _FRESH_S:
            # Also a cloud that does not answer is asked only so often.
            _keep(path, names)
            asking = _ask_in_background()
            if not names:
                asking.wait(_PATIENCE_S)
                return _kept(path)
        return names
    return []


def _kept(path: Path) -> list[str]:
    return list(json.loads(path.read_text())) if path.exists() else []


def _keep(path: Path, names: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path, force=True) as part:
        part.write_text(json.dumps(names))


def _ask_in_background() -> subprocess.Popen[Any]:
    """Run this very completion in a process of its own, which outlives this one."""
    return subprocess.Popen(
        [sys.executable, "-m", "iort_station.cli.main"],
        env={**os.environ, _ASKS: "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _kept_at(options: CloudOptions, *key: str) -> Path:
    """The file of the names; another cloud has other ones."""
    embedded = options.file()
    chosen = [os.environ.get(name) for name in ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION")]
    began = embedded.stat().st_mtime if embedded and embedded.exists() else None
    text = repr((options, embedded, began, chosen, key))
    return cache(os.environ) / "names" / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"


# Words to the operator: on standard error, where they do not get into a pipe, and in the help.


@contextmanager
def resumable(verb: str) -> Iterator[None]:
    """A verb that goes on if it is called again, whose page lists the rights that it needs."""
    try:
        yield
    except KeyboardInterrupt:
        say(f"interrupted: {verb} again, and it goes on")
        raise
    except ClientError as error:
        denied = {"AccessDenied", "AccessDeniedException", "ForbiddenException", "403"}
        if error.response["Error"]["Code"] not in denied:
            raise
        raise StationError(
            f"{error}: docs/how-to/{verb}.md lists the rights that `iort {verb}` needs"
        ) from error


def say(*lines: str) -> None:
    """Print a text, or several lines. What a robot has said begins no line of its own."""
    print("iort: " + "\n".join(map(one_line, lines)), file=sys.stderr, flush=True)


def examples(*commands: str) -> str:
    """The end of a verb's help: commands that work as they are. Tests run them."""
    # The first line keeps click from joining the others.
    return "\n".join(["\b", "Examples:", *(f"  iort {command}" for command in commands)])


def say_refused(count: int, reason: str) -> None:
    """Say what is stored and cannot be read, if there is something; ``reason`` names the first."""
    if count:
        say(f"{count:,} stored items cannot be read and are left out; the first: {reason}")


def say_archived(archived: Archived | None) -> None:
    """Say what came from the archive, if something did."""
    if archived is not None:
        hours = "an hour" if archived["hours"] == 1 else f"{archived['hours']:,} hours"
        say(f"{hours} from the archive, {iso_s(archived['from_us'])} to {iso_s(archived['to_us'])}")


def option(text: str, *names: str, **how: Any) -> Any:
    """An option of a verb, with its help; its names are made of the parameter's unless given."""
    return typer.Option(*names, help=text, **how)


def argument(text: str, **how: Any) -> Any:
    """An argument of a verb, with its help."""
    return typer.Argument(help=text, **how)


Robot = Annotated[str, argument("The robot's name.", autocompletion=robots)]
Stream = Annotated[str, argument("The stream, for example vesc.", autocompletion=streams)]
OneRobot = Annotated[str | None, option("Only this robot.", "--robot", autocompletion=robots)]
Fields = Annotated[
    str | None,
    option(
        f"Only these fields, separated by commas; {' and '.join(DERIVED)} are derived.",
        "--fields",
        autocompletion=fields,
    ),
]
Where = Annotated[str | None, option("Filter, for example 'speed_mps > 1.2 and fault_code == 0'.", "--where")]
Every = Annotated[str | None, option("Combine samples: 100ms, 1s, 1m.", "--every")]
From = Annotated[
    str | None,
    option("Start time: -10m, 20:04, 2026-05-04T10:00:00Z. With --to alone: the beginning.", "--from"),
]
To = Annotated[str | None, option("End time (exclusive). With --from alone: now.", "--to")]
Last = Annotated[str | None, option("The time up to now: 5m, 2h, 7d; or all.", "--last")]
AsJson = Annotated[bool, option("Print JSON.", "--json")]
DryRun = Annotated[bool, option("Only say what would be done.", "--dry-run")]
Force = Annotated[bool, option("Overwrite what is there.", "--force")]
Yes = Annotated[bool, option("Do not ask. A script must give it.", "--yes")]
State = Annotated[
    Path | None,
    option("The state folder of `make up`. Default: the user's own.", envvar="IORT_STATE", metavar="FOLDER"),
]
Token = Annotated[str, option("PubNub's access token for reading, if needed.", envvar="PUBNUB_ACCESS_TOKEN")]
Blind = Annotated[bool, option("Move a car with a camera without its picture; recorded.", "--blind")]
LiveWay = Annotated[
    Literal["pubnub", "iot"] | None,
    option("The way of live messages: PubNub, or AWS IoT's own. Default: the deployment's.", "--live"),
]
TrackFile = Annotated[
    Path | None, option("A CSV file of the cars' track, which the page shows.", "--track", metavar="FILE")
]

# The range of a verb that would otherwise read years.
SHORT = "5m"


def state_folder(context: typer.Context, state: Path | None) -> Path:
    """The state folder of the kept cloud that is meant: --state, that of --embedded, or the user's own."""
    embedded: Path | None = context.obj.embedded
    if state is None and embedded is not None and (embedded.parent / VERSION).exists():
        state = embedded.parent
    return (state or kept.folder()).expanduser().absolute()


def running_state(context: typer.Context, state: Path | None) -> Path:
    """The state folder of the cloud that every other verb would use, or of --state.

    Raises `UsageError` if that cloud is one that is thrown away.
    """
    file: Path | None = context.obj.file()
    if state is None and file is not None and not (file.parent / VERSION).exists():
        raise UsageError(
            f"the cloud here is that of {file}, which is thrown away at its end: --state names the folder of "
            f"one of `make up`, by default {kept.folder()}"
        )
    return state_folder(context, file.parent if state is None and file is not None else state)


def agreed(question: str, *, yes: bool) -> None:
    """Ask before something is destroyed; a no ends the command.

    Raises `UsageError` where nobody can answer.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise UsageError(f"{question} Nobody can answer here: give --yes")
    typer.confirm(question, abort=True, err=True)


def assigned(text: str, example: str) -> tuple[str, str]:
    """The name and the value of NAME=VALUE; raises `UsageError`."""
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise UsageError(f"must be NAME=VALUE, for example {example}, got {text}")
    return name, value


def names(fields: str | None) -> list[str] | None:
    """The names in a comma-separated list; None for an empty one."""
    return [name.strip() for name in (fields or "").split(",") if name.strip()] or None


@dataclass(frozen=True)
class Range:
    """From a time (inclusive) to a time (exclusive), in microseconds; None for an open side."""

    start_us: int | None
    end_us: int | None


@dataclass(frozen=True)
class When:
    """The options --from, --to and --last, as they were given; a verb has them by `ranged`."""

    start: From = None
    end: To = None
    last: Last = None

    def range(self, usual: str = "all") -> Range:
        """The range of the options; ``usual`` is the --last of a verb that got none of them.

        Raises `UsageError` for a text that is not a time, and if the options contradict one another.
        """
        now_us = time.time_ns() // 1000
        if self.start is None and self.end is None:
            if self.last is None and usual != "all":
                say(f"no range is given: the last {usual}; --last all reads everything")
            last = self.last or usual
            return Range(None, None) if last == "all" else Range(now_us - duration_us(last), now_us)
        if self.last is not None:
            raise UsageError("give --last, or --from and --to")
        start_us = None if self.start is None else _time_us(self.start, now_us)
        end_us = now_us if self.end is None else _time_us(self.end, now_us)
        if start_us is not None and start_us > end_us and self.end is not None and is_clock(self.end):
            # That time of day after the start.
            end_us += duration_us("1d")
        if start_us is not None and start_us > end_us:
            raise UsageError("the range ends before it starts")
        return Range(start_us, end_us)


def _time_us(text: str, now_us: int) -> int:
    """Parse a time, and say in which zone if it has none."""
    t_us = time_us(text, now_us)
    if not has_zone(text):
        # Another season may have another offset than today.
        zone = datetime.fromtimestamp(t_us / 1e6).astimezone()
        day = f"{zone:%Y-%m-%d} " if is_clock(text) else ""
        say(f"{text} is read as {day}{zone.tzname()} (UTC{zone.strftime('%z')}), this machine's zone")
    return t_us


def spread(
    parameter: str, options: Mapping[str, Any], made_of: Callable[..., Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a verb these options in place of its ``parameter``, which typer does not know how to read: it gets
    what ``made_of`` makes of them."""

    def decorated(verb: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(verb)
        def called(**given: Any) -> None:
            verb(**{parameter: made_of(**{name: given.pop(name) for name in options})}, **given)

        signature, keyword = inspect.signature(verb, eval_str=True), inspect.Parameter.KEYWORD_ONLY
        parameters: list[inspect.Parameter] = []
        for each in signature.parameters.values():
            parameters += (
                [
                    inspect.Parameter(name, keyword, default=None, annotation=of)
                    for name, of in options.items()
                ]
                if each.name == parameter
                else [each.replace(kind=keyword)]
            )
        called.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]  # read by inspect
        called.__annotations__ = {each.name: each.annotation for each in parameters}
        return called

    return decorated


ranged = spread("when", get_type_hints(When, include_extras=True), When)


# The cloud of an `iort` command, from the options before its name.


@dataclass
class CloudOptions:
    """The options that select a cloud; commands read it from ``context.obj``."""

    namespace: str
    profile: str | None
    region: str | None
    local: bool
    embedded: Path | None

    def cloud(self) -> Cloud:
        """The selected cloud, which is said on standard error: see `Cloud.find`."""
        return Cloud.find(**asdict(self), say=say)

    def file(self) -> Path | None:
        """The file of the embedded cloud that is named, or that runs here; None if there is none."""
        return self.embedded or embedded_here()

    def means_kept(self, folder: Path) -> bool:
        """Whether the cloud of `make up` in this folder is meant: it is up, or was killed."""
        if self.embedded is not None:
            return self.embedded.absolute().parent == folder
        said = self.profile or self.region or any(os.environ.get(name) for name in AWS_NAMED)
        there = (folder / kept.UP).exists()
        return there and (self.local or not said) and find_embedded(Path.cwd()) is None

    def account(self, *, region: str) -> Cloud:
        """An AWS account, never an embedded cloud; ``region`` is the default.

        Raises `StationError` if the options select the embedded cloud, or if credentials are missing.
        """
        if self.local:
            raise StationError("only AWS has this, and --local selects the embedded cloud")
        cloud = Cloud(namespace=self.namespace, profile=self.profile, region=self.region)
        try:
            named = cloud.region_name
        except BotoCoreError as error:
            raise StationError(f"AWS: {error}") from error
        return replace(cloud, region=named or region).check()
