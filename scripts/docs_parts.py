"""Fills the generated parts of README.md, of docs/ and of the page's contract.ts: `make docs-parts`.

A part stands between two comments. The first holds a call of a function of this module, and cog
(https://cog.readthedocs.io) replaces what follows by what the function prints.
"""

from __future__ import annotations

import html
import inspect
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import typer
from cogapp import Cog
from typer.cli import get_docs_for_click

import iort_agent.errors
import iort_station
import iort_station.errors
from bench.report import Ratio
from bench.sections.cost import fleets
from iort_agent.sources.sim import faults as sim_faults
from iort_contract.catalog import alarms as catalogued
from iort_contract.catalog.alarms import Alarm
from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.metrics import METRICS
from iort_contract.catalog.questions import CAR_LIMITS, QUESTIONS
from iort_contract.catalog.rules import RULES, Call, Store
from iort_contract.catalog.streams import CATALOG
from iort_contract.catalog.vesc import VESC
from iort_contract.cloud import PUBNUB
from iort_contract.messages.commands import REFUSALS
from iort_contract.messages.questions import REASONS
from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.usage import Usage
from scripts import agent_reference
from scripts import page_contract as typescript
from scripts.page_contract import formula
from stacks.settings import CONTEXT_KEYS, ROOT, Settings

Row = Iterable[str]
FILES = tuple(
    page for page in (ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))) if "[[[cog" in page.read_text()
)
PAGE = ROOT / "station" / "web" / "src" / "base" / "contract.ts"
EXAMPLES = ROOT / "docs" / "examples"
DECISIONS = ROOT / "docs" / "decisions"
REPORT = ROOT / "docs" / "bench" / "report.json"


def main(*files: Path, check: bool = False) -> int:
    """Fill every part; with ``check`` change nothing, and return a status that is not 0 if one is old."""
    mode = ["--check", "--diff", "--check-fail-msg=run `make docs-parts`"] if check else ["-r"]
    command = ["cog", *mode, "-P", "-p", "from scripts.docs_parts import *", "--verbosity=1"]
    return int(Cog().main([*command, *map(str, files or (*FILES, PAGE))]))


page_contract = typescript.page_contract


def table(*head: str) -> Callable[[Callable[..., Iterable[Row]]], Callable[..., None]]:
    """Turn a function that gives a table's rows into a part that prints the table."""

    def decorate(rows: Callable[..., Iterable[Row]]) -> Callable[..., None]:
        @wraps(rows)
        def part(*arguments: str) -> None:
            _table(head, rows(*arguments), right=False)

        return part

    return decorate


def _codes(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


@table("field", "unit", "meaning", "group", "ROS")
def fields() -> Iterator[Row]:
    """The VESC's fields."""
    for field in VESC.fields:
        unit = f"{field.unit} (ROS 2: {field.ros2_unit})" if field.ros2_unit else field.unit
        yield f"`{field.name}`", unit, field.meaning, field.group, ", ".join(map(str, field.ros))


@table("fault", "what it does", "weak, middle, strong", "unit")
def faults() -> Iterator[Row]:
    """The faults of a simulated car, with their strengths."""
    for name, kind in sim_faults.KINDS.items():
        strengths = {", ".join(f"{one:g}" for one in of): field for field, of in kind.by_field.items()}
        if len(strengths) < 2:
            strengths = {", ".join(f"{one:g}" for one in kind.strengths): ", ".join(kind.by_field)}
        texts = (f"{of} ({field})" if field else of for of, field in strengths.items())
        yield f"`{name}`", kind.meaning, "; ".join(texts), kind.unit


@table("kind", "meaning", "what to do", "cannot be told from", "explains")
def finding_kinds() -> Iterator[Row]:
    """The kinds of findings."""
    for kind in KINDS.values():
        others, explained = "; ".join(kind.alternatives), _codes(kind.explains)
        yield f"`{kind.name}`", kind.meaning, kind.action, others or "-", explained or "-"


@table("parameter", "meaning", "worse", "kind", "smallest change")
def finding_parameters() -> Iterator[Row]:
    """The parameters whose changes are findings."""
    for one in PARAMETERS.values():
        if one.kind:
            least = [f"{one.least_share:.0%}"] if one.least_share else []
            least += [f"{one.least:g} {one.unit}".removesuffix(" 1")] if one.least else []
            yield f"`{one.name}`", one.meaning, one.worse, f"`{one.kind}`", " and ".join(least)


@table("derived field", "unit", "meaning", "formula")
def derived() -> Iterator[Row]:
    """The derived fields."""
    yield from ((f"`{d.name}`", d.unit, d.meaning, f"`{formula(d)}`") for d in DERIVED.values())


@table("field", "unit", "meaning")
def stream(name: str) -> Iterator[Row]:
    """The fields of a stream."""
    yield from ((f"`{field.name}`", field.unit or "-", field.meaning) for field in CATALOG[name].fields)


@table("key", "default", "meaning")
def settings() -> Iterator[Row]:
    """The deployment's parameters."""
    for name, field in Settings.model_fields.items():
        if name in CONTEXT_KEYS:
            default = str(field.default).replace(f"{ROOT}/", "").lower()
            shown = "none" if default in ("none", "{}", "") else default.removesuffix(".0")
            yield f"`{name}`", shown, field.description or ""


@table("who", "what", "at most", "held by", "dollars a day")
def spending() -> Iterable[Row]:
    """What one robot and one stranger can spend at most, by the default deployment's templates."""
    from scripts import ceilings  # noqa: PLC0415 - the CDK takes seconds to load

    return ceilings.rows()


@table("question", "answer", "a robot and hour", "s at most", "question, KiB", "answer, KiB")
def questions() -> Iterator[Row]:
    """The questions that a robot may ask."""
    for q in QUESTIONS.values():
        sizes = (f"{size / 1024:g}" for size in (q.max_question_bytes, q.max_answer_bytes))
        yield f"`{q.name}`", q.meaning, str(q.per_hour), str(q.timeout_s), *sizes


@table("limit", "unit", "meaning", "default", "from the calibration")
def car_limits() -> Iterator[Row]:
    """The limits of a car in the question raceline."""
    for one in CAR_LIMITS.values():
        yield f"`{one.name}`", one.unit, one.meaning, f"{one.default:g}", _codes(one.calibrated)


@table("`refused`", "meaning")
def reasons() -> Iterator[Row]:
    """Why a question has no answer."""
    yield from ((f"`{name}`", text) for name, text in REASONS.items())


@table("`outcome`", "meaning")
def refusals() -> Iterator[Row]:
    """Why a motion was refused."""
    yield from ((f"`{name}`", text) for name, text in REFUSALS.items())


@table("rule", "what it does", "messages go to", "from")
def rules() -> Iterator[Row]:
    """The topic rules: what each does, where its messages go, and its SELECT."""
    for rule in RULES.values():
        action = rule.action
        if isinstance(action, Store):
            target = f"table {action.table}"
        elif isinstance(action, Call):
            target = f"function `{action.function}`"
        else:
            target = f"topic `{action.lane}/.../{action.name}`"
        yield f"`{rule.name}`", rule.meaning, target, f"`{rule.statement().split(' FROM ')[1]}`"


@table("metric", "function", "unit", "statistic", "chart", "alarm")
def metrics() -> Iterator[Row]:
    """The metrics of the functions."""
    for metric in METRICS.values():
        alarm = "yes" if metric.alarm else ""
        yield f"`{metric.name}`", metric.function, metric.unit, metric.statistic, metric.chart, alarm


@table("alarm", "what happened", "goes off", "what to do")
def alarms() -> Iterator[Row]:
    """The alarms."""
    ours = {metric.name: metric.alarm for metric in METRICS.values() if metric.alarm}
    account = {name: alarm for (_, name), alarm in catalogued.OF_THE_ACCOUNT.items()}
    # The resource's name stands before these.
    resources = {f"...{ending}": alarm for ending, alarm in catalogued.OF_RESOURCES.items()}
    for name, alarm in {**ours, **resources, **catalogued.OF_ONE_RESOURCE, **account}.items():
        yield f"`{name}`", alarm.meaning, _condition(alarm), alarm.action


def _condition(alarm: Alarm) -> str:
    limit = f"`{alarm.threshold}`" if isinstance(alarm.threshold, str) else f"{alarm.threshold:g}"
    often = f", {alarm.periods} of {alarm.within} minutes" if alarm.within else ""
    if alarm.periods > 1 and not alarm.within:
        often = f", {alarm.periods} minutes in a row"
    return f"{'below' if alarm.below else 'above'} {limit}{often}"


@table("error", "meaning")
def errors() -> Iterator[Row]:
    """The errors of the agent and of the station."""
    for module in (iort_agent.errors, iort_station.errors):
        for name, cls in vars(module).items():
            if isinstance(cls, type) and issubclass(cls, Exception):
                meaning = (cls.__doc__ or "").strip().splitlines()[0].replace("``", "`")
                yield f"`{module.__name__}.{name}`", meaning


def library() -> None:
    """The signatures of the library's names."""
    print("```python")
    for name in iort_station.__all__:
        value = getattr(iort_station, name)
        if not inspect.isclass(value):
            print(_signature(name, value))
            continue
        bases = ", ".join(base.__name__ for base in value.__bases__ if base is not object)
        print(f"class {name}({bases}):" if bases else f"class {name}:")
        for of, annotation in getattr(value, "__annotations__", {}).items():
            if of[0] != "_":
                print(f"    {of}: {getattr(annotation, '__forward_arg__', annotation)}")
        for of, method in vars(value).items():
            if of[0] != "_" and inspect.isfunction(method):
                print(f"    {_signature(of, method)}")
    print("```")


def _signature(name: str, function: Callable[..., Any]) -> str:
    # Annotations are texts, which `inspect` would show in quotes.
    return re.sub(r"(: |-> )'(.*?)'(?=[,) ]|$)", r"\1\2", f"def {name}{inspect.signature(function)}")


def cost(name: str) -> None:
    """A table of the cost model: a robot's hour, what changes if, or fleets of several sizes."""
    usage = Usage()
    if name == "scale":
        rows = fleets(usage)
    else:
        print(f"List prices of {AS_OF}, {REGION}, in US dollars; one robot, {usage.rate_hz:g} Hz.\n")
        tables = {
            "hour": report.robot_hour,
            "month": report.month,
            "whatif": report.what_if,
        }
        rows = tables[name](usage)
    _table(rows.head, rows.body)


def month() -> None:
    """What the default deployment costs a month with a robot, all in, and what PubNub adds."""

    def dollars(usage: Usage) -> tuple[float, float]:
        """For the driving, and for the deployment itself."""
        driving = model.dollars_per_month(model.bill(usage), usage)
        return driving, sum(report.deployment_dollars_per_month(usage).values())

    usage = Usage(robots=1, hours_per_day=2.0)
    by_pubnub = replace(usage, live_transport=PUBNUB)
    driving, fixed = dollars(usage)
    plan = model.pubnub_mau_dollars_per_month(by_pubnub) or 0.0
    more = sum(dollars(by_pubnub)) + plan - driving - fixed
    print(
        "With one robot that drives two hours a day, watched live, the default deployment costs "
        f"${driving + fixed:.0f} a month\n"
        f"on AWS at most, all in, at list prices: ${driving:.0f} for the driving with archive and analysis,\n"
        "the rest for itself, mostly for metrics and alarms.\n"
        f"Live over PubNub instead of AWS IoT adds ${more:.0f}, with PubNub's smallest plan."
    )


def headline() -> None:
    """The kept bench report's ratios that have a target, and the machine of the measurement."""
    kept = json.loads(REPORT.read_text())
    machine = kept["machine"]
    on = f"{machine['cores']} cores of {machine['cpu']}, target {kept['target']}"
    print(f"Made on {machine['date'][:10]} on {on}:\n")
    ratios = [Ratio(**ratio) for section in kept["sections"] for ratio in section["ratios"]]
    rows = [ratio.as_row() for ratio in ratios if ratio.target is not None]
    _table(("ratio, side by side in one run", "measured", "target", "reached"), rows)


def measured() -> None:
    """Five of the kept report's figures, beside the thesis'."""
    kept = json.loads(REPORT.read_text())
    value = {ratio["name"]: ratio["value"] for section in kept["sections"] for ratio in section["ratios"]}
    delay_ms = 300 * value["car to subscriber with 25 ms each way / thesis' 300 ms"]
    cycle_ms = 2 * value["node's cycle / thesis' 2 ms"]
    query = value["query, client's processor: thesis' layout / ours"]
    cost = 1 / value["cost with the live lane at 10 Hz / a message a sample"]
    lost = value["samples lost over an outage"]
    rows = [
        ("car to dashboard, with the thesis' ping of 50 ms", f"{delay_ms:.0f} ms", "250-300 ms"),
        ("the car's node, processor time of a sample", f"{cycle_ms:.3f} ms", "2 ms"),
        ("a query of 14,368 points, processor time", f"1/{query:.0f}", "1"),
        ("AWS for a robot-hour, live lane at 10 Hz by PubNub", f"1/{cost:.1f}", "1"),
        ("samples lost over 60 s without a broker", f"{lost:g}", "not measured"),
    ]
    _table((f"measured on {kept['machine']['date'][:10]}", "iort", "thesis"), rows)


def car_yaml() -> None:
    """The sections of car.yaml."""
    for section in agent_reference.sections():
        print(f"\n## {section.path or 'The file'}\n\n{section.meaning}\n")
        _table(("key", "default", "allowed"), section.rows, right=False)


def agent_manual() -> None:
    """The command `iort-agent`."""
    for command in agent_reference.commands():
        print(f"\n## `iort-agent {command.path}`\n\n{command.meaning}\n")
        _table(("option", "meaning"), command.rows, right=False)


def example(name: str) -> None:
    """A file of docs/examples."""
    language = {".py": "python", ".mjs": "javascript"}.get(Path(name).suffix, "c")
    print(f"```{language}\n{(EXAMPLES / name).read_text()}```")


def decisions() -> None:
    """The decisions by subject, each with its title."""
    for folder in sorted(DECISIONS.iterdir()):
        if folder.is_dir():
            print(f"\n## {folder.name.capitalize()}\n")
            for page in sorted(folder.glob("*.md")):
                number, _, title = page.read_text().partition("\n")[0].removeprefix("# ").partition(". ")
                print(f"- {number}: [{title}]({page.relative_to(DECISIONS)})")


def manual() -> None:
    """The command `iort`, as typer describes it."""
    root: Any = typer.main.get_command(app)
    root.commands = {name: verb.load() for name, verb in root.commands.items()}
    _whole_sentences(root)
    text = get_docs_for_click(obj=root, ctx=typer.Context(root), name="iort")
    text = re.sub(r"\x08\nExamples:\n((?:  .*\n)+)", _console, text)
    # The page has a title of its own. The text is escaped for HTML; Markdown shows an apostrophe as it is.
    print(html.unescape(text.partition("\n\n")[2]).strip())


def _console(found: re.Match[str]) -> str:
    """A verb's examples as a console's text."""
    commands = (f"$ {line.strip()}" for line in found[1].splitlines())
    return "\n".join(["**Examples**:", "", "```console", *commands, "```", ""])


def _whole_sentences(group: Any) -> None:
    """Give each command its first sentence as summary; typer cuts it after 45 characters."""
    for command in group.commands.values():
        command.short_help = " ".join((command.help or "").split()).split(". ")[0].rstrip(".")
        if hasattr(command, "commands"):
            _whole_sentences(command)


def _table(head: Iterable[str], body: Iterable[Iterable[str]], *, right: bool = True) -> None:
    """Print a Markdown table; ``right`` aligns every column but the first."""
    titles = list(head)
    for row in (titles, ["---", *(("---:" if right else "---") for _ in titles[1:])], *body):
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    sys.exit(main(check="--check" in sys.argv))
