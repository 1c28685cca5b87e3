"""`iort recorder dry-run`, and the options of a trigger; `triggers` has the other verbs of the group."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import typer

from iort_contract.expression import ExpressionError
from iort_contract.limits import ContractError
from iort_contract.messages.recorder import Trigger
from iort_contract.triggers import check_trigger
from iort_station.cli import options
from iort_station.cli.console import out, print_json, reading, table
from iort_station.cli.options import AsJson, Force, When, argument, examples, option, ranged, spread
from iort_station.errors import UsageError
from iort_station.output import check_free, one_line
from iort_station.times import between_hours, duration_us, iso, iso_s

if TYPE_CHECKING:
    from iort_station.data.dry_run import DryRun

commands = typer.Typer(
    name="recorder", no_args_is_help=True, help="What robots keep of what happened, and when."
)
# Times that a terminal shows; JSON and the picture have every one.
_ROWS = 20
_BUDGET = re.compile(r"(\d+(?:\.\d+)?)\s*(MB|GB)(?:/day)?", re.IGNORECASE)

Robots = Annotated[str, option("The robots, separated by commas.", "--robots", autocompletion=options.robots)]


@dataclass(frozen=True)
class Rule:
    """The options of a trigger, as they were given; a verb has them by `ruled`."""

    condition: Annotated[
        str | None, option("The condition, for example 'current_input < -15 and speed_mps > 2'.", "--when")
    ] = None
    on: Annotated[
        Literal["stop", "disconnect", "fault", "service", "finding"] | None,
        option("What fires it instead of a condition."),
    ] = None
    stream: Annotated[
        str | None,
        option("The stream of the condition's fields. Default: vesc.", autocompletion=options.streams),
    ] = None
    others: Annotated[
        list[str] | None,
        option("A stream whose fields the condition names as pose.x; may be repeated.", "--other"),
    ] = None
    before: Annotated[str | None, option("How long before it to keep. Default: 30s.")] = None
    after: Annotated[str | None, option("How long after it to keep. Default: 10s.")] = None
    topics: Annotated[
        str | None,
        option("ROS topics or streams to keep, separated by commas, such as '/camera/*'. Default: all."),
    ] = None
    cooldown: Annotated[str | None, option("Ignore it for so long after it fired. Default: 60s.")] = None
    budget: Annotated[str | None, option("The most to upload, for example 500MB/day. Default: no limit.")] = (
        None
    )
    notify: Annotated[bool | None, option("Only tell, and keep nothing.", "--notify")] = None

    @property
    def given(self) -> bool:
        """Whether any option is given."""
        return self != Rule()

    def trigger(self, name: str) -> Trigger:
        """The trigger of these options; raises `UsageError` for one that no robot accepts."""
        given: dict[str, Any] = {
            "when": self.condition,
            "on": self.on,
            "stream": self.stream,
            "others": tuple(self.others) if self.others else None,
            "before_s": _seconds(self.before),
            "after_s": _seconds(self.after),
            "topics": tuple(options.names(self.topics) or ()) or None,
            "cooldown_s": _seconds(self.cooldown),
            "budget_mb_day": None if self.budget is None else _megabytes(self.budget),
            "notify": self.notify,
        }
        return checked(Trigger(name, **{key: value for key, value in given.items() if value is not None}))


def checked(trigger: Trigger) -> Trigger:
    """The trigger, as far as the station can check it without the robot's vehicle; raises `UsageError`."""
    try:
        # A derived field may have its parameters in the registry.
        check_trigger(Trigger(**{**vars(trigger), "gain": trigger.gain or 1.0}))
    except (ContractError, ExpressionError) as error:
        raise UsageError(str(error)) from error
    return trigger


ruled = spread("rule", get_type_hints(Rule, include_extras=True), Rule)


def _seconds(text: str | None) -> float | None:
    if text is None:
        return None
    return 0.0 if text.strip() in ("0", "0s") else duration_us(text) / 1e6


def _megabytes(text: str) -> float:
    match = _BUDGET.fullmatch(text.strip())
    if match is None:
        raise UsageError(f"--budget must be MB or GB a day, such as 500MB/day, got {text!r}")
    return float(match[1]) * (1_000 if match[2].upper() == "GB" else 1)


@commands.command(
    "dry-run",
    epilog=examples(
        "recorder dry-run --robots car7 --when 'current_motor > 30 and speed_mps > 2' --last 7d",
        "recorder dry-run --robots car7 --when 'delta(speed, 1s) < -3000' --last 1h --out when.png",
    ),
)
@ranged
@ruled
def dry_run(
    context: typer.Context,
    robots: Robots,
    rule: Rule,
    when: When,
    name: Annotated[str | None, argument("A trigger that the robots have, instead of --when.")] = None,
    picture: Annotated[
        Path | None, option("Draw when it would have fired: .png, .svg or .pdf.", "--out", "-o")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Count how often a trigger would have fired in stored samples, and what it would have uploaded.

    The times are those that the robots would have found: it is the same evaluation. Bytes are estimated from
    the robots' recorded messages: what only the ring keeps is not in them. The default range is a day.
    """
    # numpy takes longer to load than most commands to run.
    from iort_station.data import dry_run as dry  # noqa: PLC0415 - see above

    if (name is None) == (not rule.given):
        raise UsageError("give either the name of a trigger that the robots have, or --when")
    if picture is not None:
        _plots().check_ending(picture)
        check_free(picture, force=force)
    wanted = rule.trigger("trigger") if name is None else None
    within = when.range("1d")
    cloud, found = context.obj.cloud(), []
    for robot in options.names(robots) or []:
        trigger = wanted or dry.stored_trigger(cloud, robot, str(name))
        with reading(robot, within.start_us, within.end_us) as progress:
            one = dry.dry_run(cloud, robot, trigger, within.start_us, within.end_us, progress=progress)
        options.say_refused(one.refused, one.reason)
        options.say_archived(one.origin.told())
        found.append(one)
    if not found:
        raise UsageError("--robots names no robot")
    if picture is not None:
        plots = _plots()
        lines = [line for one in found for line in dry.lines(cloud, one, within.start_us, within.end_us)]
        marks = {one.robot: (one.edges, one.windows) for one in found}
        plots.save(plots.moments(lines, marks), picture, force=force)
        options.say(f"{picture} shows when")
    if as_json:
        print_json([_facts(one) for one in found])
    else:
        for one in found:
            _print(one)


def _facts(one: DryRun) -> dict[str, Any]:
    archived = one.origin.told()
    upload, stored = _dollars(one)
    return {
        "robot": one.robot,
        "condition": one.trigger.when or one.trigger.on,
        "samples": one.samples,
        "from": None if one.first_us is None else iso(one.first_us),
        "to": None if one.last_us is None else iso(one.last_us),
        "edges": [
            {"time": iso(edge.t_us), "time_us": edge.t_us, "values": dict(edge.values)} for edge in one.edges
        ],
        "windows": [
            {
                "from": iso(window.from_us),
                "from_us": window.from_us,
                "to": iso(window.to_us),
                "to_us": window.to_us,
                "edges": len(window.edges),
            }
            for window in one.windows
        ],
        "streams": [upload._asdict() for upload in one.uploads],
        "bytes": one.bytes,
        "bytes_within_budget": one.within_budget,
        "dollars": upload,
        "dollars_a_month": stored,
        "archive": archived and between_hours(archived),
    }


def _dollars(one: DryRun) -> tuple[float, float]:
    from iort_station.cost.report import incident_dollars  # noqa: PLC0415 - as above

    return incident_dollars(0 if one.trigger.notify else len(one.windows), one.within_budget)


def _print(one: DryRun) -> None:
    condition = one.trigger.when or one.trigger.on
    if one.first_us is None or one.last_us is None:
        out.print(f"{one.robot}: no samples in this range", soft_wrap=True)
        return
    span = f"{one.samples:,} samples, {iso_s(one.first_us)} to {iso_s(one.last_us)}"
    times = {0: "never have fired", 1: "have fired once"}.get(
        len(one.edges), f"have fired {len(one.edges):,} times"
    )
    out.print(f"{one.robot}: {condition} would {times} ({span})", soft_wrap=True)
    if not one.edges:
        return
    kept = {edge.t_us for window in one.windows for edge in window.edges}
    shown = table("time (UTC)", "values", "", left=("time (UTC)", "values", ""))
    for edge in one.edges[:_ROWS]:
        shown.add_row(iso(edge.t_us), _values(edge.values), "" if edge.t_us in kept else "in the cooldown")
    out.print(shown)
    if len(one.edges) > _ROWS:
        options.say(f"{_ROWS} of {len(one.edges):,} shown; --json prints every one")
    seconds = sum(window.to_us - window.from_us for window in one.windows) / 1e6
    what = "would be told" if one.trigger.notify else f"would be kept, {seconds:,.0f} s in all"
    many = "1 incident" if len(one.windows) == 1 else f"{len(one.windows):,} incidents"
    out.print(
        f"{many} {what}, after the cooldown of {one.trigger.cooldown_s:g} s and merging", soft_wrap=True
    )
    if not one.trigger.notify:
        _print_uploads(one)


def _print_uploads(one: DryRun) -> None:
    if not one.uploads:
        out.print("none of the recorded streams is among the topics: what they take is not known")
        return
    shown = table("stream", "topics", "messages", "size", left=("stream", "topics"))
    for upload in one.uploads:
        topics = ", ".join(upload.topics)
        shown.add_row(upload.stream, topics, f"{upload.messages:,}", _size(upload.bytes))
    out.print(shown)
    upload_usd, stored_usd = _dollars(one)
    budget = one.trigger.budget_mb_day
    within = f", {_size(one.within_budget)} within {budget:g} MB a day" if budget else ""
    out.print(
        f"about {_size(one.bytes)} before compression{within}: {_usd(upload_usd)} to upload, "
        f"{_usd(stored_usd)} a month to keep",
        soft_wrap=True,
    )


def _size(size: int) -> str:
    return f"{size / 1e6:,.1f} MB" if size >= 1e6 else f"{size / 1e3:,.1f} kB"


def _usd(dollars: float) -> str:
    return f"${dollars:,.2f}" if dollars >= 0.01 else "less than $0.01"


def _values(values: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {one_line(str(value))}"
        for name, value in values.items()
    )


def _plots() -> Any:
    from iort_station.cli import plots  # noqa: PLC0415 - as above

    return plots
