"""`iort recorder add`, `list`, `remove` and `take`: what robots are to keep, and their answers."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer

from iort_contract.messages.recorder import KEPT, UPLOADED, Incident, Take
from iort_contract.topics import ACCEPTED
from iort_station.cli import options
from iort_station.cli.console import errors, listing, out, table, tell
from iort_station.cli.options import AsJson, Robot, When, argument, examples, option, ranged
from iort_station.cli.verbs.incidents import as_fields, show, size
from iort_station.cli.verbs.recorder import Robots, Rule, commands, ruled
from iort_station.errors import StationError, UsageError
from iort_station.fleet import recorder, registry
from iort_station.fleet.recorder import Answer, RobotTrigger
from iort_station.operations.alarms import user

_POLL_S = 0.5
# A robot that is connected looks once a second.
_ANSWER_S = 15.0

Name = Annotated[str, argument("The trigger's name.", metavar="NAME")]


@commands.command(
    "add",
    epilog=examples(
        "recorder add hardbrake --robots car7 --when 'current_input < -15 and speed_mps > 2'",
        "recorder add stops --robots car7 --on stop --before 60s",
    ),
)
@ruled
def add(
    context: typer.Context,
    name: Name,
    robots: Robots,
    rule: Rule,
    new: Annotated[
        bool, option("Its stream, fields or topics are not recorded yet: they will come.", "--new")
    ] = False,
    seconds: Annotated[float, option("How long to wait for the robots' answers.", min=0)] = 10.0,
    as_json: AsJson = False,
) -> None:
    """Add a trigger to robots, or replace the one of this name, and print their answers.

    The condition is that of `iort query --where`, with delta(field, 1s), silent(stream, 1s) and `for 2s` at
    its end. A trigger that cannot fire is refused before anything is changed: its streams, fields and topics
    must be recorded. One that a robot refuses is taken back. A robot that is not connected gets it when it is
    back. Exit status 1 unless every robot that is connected has accepted it.
    """
    # numpy takes longer to load than TAB may take.
    from iort_station.data import triggers  # noqa: PLC0415 - see above

    trigger = rule.trigger(name)
    cloud, names = context.obj.cloud(), robots_of(robots)
    with errors.status("looking at what is recorded"):
        each = {robot: triggers.checked(cloud, robot, trigger, new=new) for robot in names}
    answers: dict[str, Answer] = {}
    for robot, of_robot in each.items():
        with errors.status(f"waiting for {robot}"):
            answers[robot] = recorder.add(cloud, robot, of_robot, seconds, withdraw=not new)
    facts = {robot: {"answer": one.text or None, "online": one.online} for robot, one in answers.items()}
    tell(facts, lambda: _show_answers(name, answers), as_json=as_json)
    if refused := [robot for robot, one in answers.items() if one.refused]:
        kept = "it stays, by --new" if new else "it is taken back"
        raise StationError(f"refused by {', '.join(refused)}: {kept}")
    if seconds and (silent := [robot for robot, one in answers.items() if one.online and not one.text]):
        raise StationError(
            f"no answer from {', '.join(silent)} within {seconds:g} s: is the agent running, and new enough? "
            "The trigger stays: `iort recorder list` shows the answer, `iort recorder remove` removes it"
        )


def robots_of(robots: str) -> list[str]:
    """The robots of a list with commas; raises `UsageError` if it has none."""
    names = options.names(robots)
    if names is None:
        raise UsageError("--robots names no robot")
    return list(dict.fromkeys(names))


def _show_answers(name: str, answers: dict[str, Answer]) -> None:
    for robot, answer in answers.items():
        if answer.text:
            said = f"refused: {answer.text}" if answer.refused else answer.text
        else:
            said = "no answer yet" if answer.online else "not connected: it answers when it is back"
        out.print(f"{robot}: {name}: {said}", style="red" if answer.refused else None, soft_wrap=True)


@commands.command("list", epilog=examples("recorder list", "recorder list car7"))
def list_(
    context: typer.Context,
    robots: Annotated[list[str] | None, argument("Default: all.", autocompletion=options.robots)] = None,
    as_json: AsJson = False,
) -> None:
    """List the triggers of robots beside the robots' answers: accepted, why not, or nothing yet."""
    cloud = context.obj.cloud()
    names = robots or sorted(str(row["robot"]) for row in registry.listed(cloud))
    with errors.status("reading"):
        rows = recorder.triggers(cloud, names)
    for robot in {*(robots or [])} - {row.robot for row in rows}:
        registry.get(cloud, robot)
    if rows and not as_json:
        out.print(_table(rows))
        return
    listing(rows, _trigger_as_json, lambda _row: None, as_json=as_json, none="no triggers")


def _table(rows: list[RobotTrigger]) -> Any:
    head = ("robot", "trigger", "fires", "keeps", "a day", "answer")
    shown = table(*head, left=head, wrap=True)
    for row in rows:
        trigger, answer = row.trigger, row.answer or "not answered yet"
        if trigger is None:
            shown.add_row(row.robot, row.name, row.problem, "", "", answer, style="red")
            continue
        keeps = f"{trigger.before_s:g} s before, {trigger.after_s:g} s after"
        keeps += f": {', '.join(trigger.topics)}" if trigger.topics else ""
        shown.add_row(
            row.robot,
            row.name,
            f"{trigger.stream}: {trigger.when}" if trigger.when else f"on {trigger.on}",
            "nothing: it tells" if trigger.notify else keeps,
            f"{trigger.budget_mb_day:g} MB" if trigger.budget_mb_day else "",
            answer,
            style=None if answer == ACCEPTED else "red" if row.answer else "yellow",
        )
    return shown


def _trigger_as_json(row: RobotTrigger) -> dict[str, Any]:
    return {
        "robot": row.robot,
        "name": row.name,
        "trigger": None if row.trigger is None else dict(vars(row.trigger)),
        "answer": row.answer or None,
        "problem": row.problem or None,
    }


@commands.command("remove", epilog=examples("recorder remove hardbrake --robots car7"))
def remove(context: typer.Context, name: Name, robots: Robots, as_json: AsJson = False) -> None:
    """Remove a trigger from robots. What it has kept stays."""
    cloud, names = context.obj.cloud(), robots_of(robots)
    for robot in names:
        recorder.remove(cloud, robot, name)
    tell({"removed": name, "robots": names}, f"{name} is removed from {', '.join(names)}", as_json=as_json)


@commands.command("take", epilog=examples("recorder take car7 --last 60s --why bump"))
@ranged
def take(
    context: typer.Context,
    robot: Robot,
    when: When,
    why: Annotated[str, option("What for; the incident has it.")] = "",
    topics: Annotated[
        str | None, option("ROS topics or streams to keep, with *, separated by commas. Default: all.")
    ] = None,
    seconds: Annotated[float, option("How long to wait until it is uploaded.", min=0)] = 120.0,
    as_json: AsJson = False,
) -> None:
    """Have a robot keep what its ring has of a time, and wait until that is uploaded.

    The time is of the robot's clock. A robot that is not connected does it when it is back, as far as its
    ring reaches. Exit status 1 unless it is uploaded, or waits for a robot that is not connected.
    """
    within = when.range()
    if within.start_us is None or within.end_us is None:
        raise UsageError("give --last 60s, or --from and --to")
    # numpy takes longer to load than TAB may take.
    from iort_station.data import incidents  # noqa: PLC0415 - see above

    cloud, until = context.obj.cloud(), time.monotonic() + seconds
    before = incidents.incidents(cloud, robot, within.start_us, within.end_us)
    kept = tuple(options.names(topics) or ())
    taken = recorder.take(cloud, robot, within.start_us, within.end_us, by=user(), why=why, topics=kept)
    one = None
    with errors.status(f"waiting for {robot}") as status:
        answer = recorder.take_answer(cloud, robot, taken, min(seconds, _ANSWER_S))
        while answer.text == ACCEPTED and (one is None or one.incident.state == KEPT):
            if time.monotonic() > until:
                break
            # Nothing tells of a new sample.
            time.sleep(_POLL_S)
            one = incidents.of_take(cloud, robot, taken, before)
            status.update(
                f"{robot} has accepted it" if one is None else f"{robot}: {_progress(one.incident)}"
            )
    facts = {"robot": robot, "take": taken.id, "answer": answer.text or None, "online": answer.online}
    incident = None if one is None else as_fields(one)
    tell({**facts, "incident": incident}, lambda: _show_take(robot, taken, answer, one), as_json=as_json)
    _check_take(robot, answer, None if one is None else one.incident, seconds)


def _progress(incident: Incident) -> str:
    return f"{size(incident)} to upload" if incident.bytes else "its time is not over yet"


def _show_take(robot: str, taken: Take, answer: Answer, one: Any) -> None:
    if one is not None:
        show(one)
    elif answer.text or answer.online:
        out.print(f"{robot}: take {taken.id}: {answer.text or 'no answer yet'}", soft_wrap=True)
    else:
        away = f"{robot} is not connected: it keeps this when it is back, as far as its ring reaches"
        out.print(away, soft_wrap=True)


def _check_take(robot: str, answer: Answer, incident: Incident | None, seconds: float) -> None:
    if answer.refused:
        raise StationError(f"{robot} has refused it: {answer.text}")
    if not seconds or (not answer.text and not answer.online):
        return
    if not answer.text:
        raise StationError(
            f"{robot} has not answered: is its agent running, and has its car.yaml the section recorder?"
        )
    if incident is None or incident.state == KEPT:
        raise StationError(f"not uploaded within {seconds:g} s: `iort incidents {robot}` shows when it is")
    if incident.state != UPLOADED:
        raise StationError(f"nothing is uploaded: {incident.state.replace('_', ' ')}, {incident.why}")
