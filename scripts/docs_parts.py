"""Fills the generated parts of README.md, of docs/ and of the page's contract.ts: `make docs-parts`.

A part stands between two comments. The first holds a call of a function of this module, and cog
(https://cog.readthedocs.io) replaces what follows by what the function prints.
"""

from __future__ import annotations

import html
import json
import re
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import typer
from cogapp import Cog
from typer.cli import get_docs_for_click

import iort_agent.errors
import iort_station.errors
from bench.report import Ratio
from bench.sections.cost import fleets
from iort_agent.sources.sim import faults as sim_faults
from iort_contract.catalog.analysis import KINDS, PARAMETERS
from iort_contract.catalog.derived import DERIVED
from iort_contract.catalog.entries import Parameter
from iort_contract.catalog.questions import CAR_LIMITS, QUESTIONS
from iort_contract.catalog.streams import CATALOG
from iort_contract.catalog.vesc import VESC
from iort_contract.cloud import PUBNUB
from iort_contract.messages.commands import REFUSALS
from iort_contract.messages.questions import REASONS
from iort_station.cli.main import app
from iort_station.cost import model, report
from iort_station.cost.model import deployment_dollars_per_month
from iort_station.cost.prices import AS_OF, REGION
from iort_station.cost.usage import Usage
from scripts import agent_reference, cloud_tables
from scripts.page_contract import formula, page_contract

__all__ = [
    "agent_manual",
    "alarms",
    "car_limits",
    "car_yaml",
    "cost",
    "decisions",
    "derived",
    "errors",
    "example",
    "faults",
    "fields",
    "finding_kinds",
    "finding_parameters",
    "headline",
    "manual",
    "measured",
    "metrics",
    "month",
    "page_contract",
    "questions",
    "reasons",
    "refusals",
    "rules",
    "settings",
    "spending",
    "stream",
]

ROOT = Path(__file__).resolve().parent.parent
FILES = tuple(
    ROOT / name
    for name in (
        "README.md",
        "docs/decisions/index.md",
        "docs/explanation/benchmark.md",
        "docs/explanation/findings.md",
        "docs/how-to/alarms.md",
        "docs/how-to/ask.md",
        "docs/how-to/simulated-car.md",
        "docs/reference/car-yaml.md",
        "docs/reference/clients.md",
        "docs/reference/deployment.md",
        "docs/reference/errors.md",
        "docs/reference/fields.md",
        "docs/reference/metrics.md",
        "docs/explanation/cost.md",
        "docs/reference/iort-agent.md",
        "docs/reference/iort.md",
        "docs/reference/messages.md",
        "docs/explanation/processing.md",
        "docs/explanation/security.md",
    )
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


def fields() -> None:
    """The VESC's fields, from the catalogue."""
    rows = []
    for field in VESC.fields:
        unit = f"{field.unit} (ROS 2: {field.ros2_unit})" if field.ros2_unit else field.unit
        versions = ", ".join(map(str, field.ros))
        rows.append((f"`{field.name}`", unit, field.meaning, field.group, versions))
    _table(("field", "unit", "meaning", "group", "ROS"), rows, right=False)


def faults() -> None:
    """The faults of a simulated car, with their strengths."""
    rows = []
    for name, kind in sim_faults.KINDS.items():
        strengths = {", ".join(f"{one:g}" for one in of): field for field, of in kind.by_field.items()}
        if len(strengths) < 2:
            strengths = {", ".join(f"{one:g}" for one in kind.strengths): ", ".join(kind.by_field)}
        told = "; ".join(f"{of} ({field})" if field else of for of, field in strengths.items())
        rows.append((f"`{name}`", kind.meaning, told, kind.unit))
    _table(("fault", "what it does", "weak, middle, strong", "unit"), rows, right=False)


def finding_kinds() -> None:
    """The kinds of findings, from the catalogue."""
    rows = [
        (
            f"`{kind.name}`",
            kind.meaning,
            kind.action,
            "; ".join(kind.alternatives) or "-",
            ", ".join(f"`{name}`" for name in kind.explains) or "-",
        )
        for kind in KINDS.values()
    ]
    _table(("kind", "meaning", "what to do", "cannot be told from", "explains"), rows, right=False)


def finding_parameters() -> None:
    """The parameters whose changes are findings, from the catalogue."""
    rows = [
        (f"`{one.name}`", one.meaning, one.worse, f"`{one.kind}`", _least_change(one))
        for one in PARAMETERS.values()
        if one.kind
    ]
    _table(("parameter", "meaning", "worse", "kind", "smallest change"), rows, right=False)


def _least_change(parameter: Parameter) -> str:
    parts = [f"{parameter.least_share:.0%}"] if parameter.least_share else []
    parts += [f"{parameter.least:g} {parameter.unit}".removesuffix(" 1")] if parameter.least else []
    return " and ".join(parts)


def derived() -> None:
    """The derived fields, from the catalogue."""
    rows = [(f"`{d.name}`", d.unit, d.meaning, f"`{formula(d)}`") for d in DERIVED.values()]
    _table(("derived field", "unit", "meaning", "formula"), rows, right=False)


def stream(name: str) -> None:
    """The fields of a stream, from the catalogue."""
    rows = [(f"`{field.name}`", field.unit or "-", field.meaning) for field in CATALOG[name].fields]
    _table(("field", "unit", "meaning"), rows, right=False)


def settings() -> None:
    """The deployment's parameters."""
    _table(("key", "default", "meaning"), cloud_tables.settings_rows(), right=False)


def spending() -> None:
    """What one robot and one stranger can spend at most, by the default deployment's templates."""
    from scripts import ceilings  # noqa: PLC0415 - the CDK takes seconds to load

    _table(("who", "what", "at most", "held by", "dollars a day"), ceilings.rows(), right=False)


def questions() -> None:
    """The questions that a robot may ask, from the catalogue."""
    rows = [
        (
            f"`{q.name}`",
            q.meaning,
            str(q.per_hour),
            str(q.timeout_s),
            *map(_kib, (q.max_question_bytes, q.max_answer_bytes)),
        )
        for q in QUESTIONS.values()
    ]
    head = ("question", "answer", "a robot and hour", "s at most", "question, KiB", "answer, KiB")
    _table(head, rows, right=False)


def car_limits() -> None:
    """The limits of a car in the question raceline, from the catalogue."""
    rows = [
        (
            f"`{one.name}`",
            one.unit,
            one.meaning,
            f"{one.default:g}",
            ", ".join(f"`{p}`" for p in one.calibrated),
        )
        for one in CAR_LIMITS.values()
    ]
    _table(("limit", "unit", "meaning", "default", "from the calibration"), rows, right=False)


def _code(name: str) -> str:
    return f"`{name}`"


def _kib(size: int) -> str:
    return f"{size / 1024:g}"


def reasons() -> None:
    """Why a question has no answer."""
    _table(("`refused`", "meaning"), [(f"`{name}`", text) for name, text in REASONS.items()], right=False)


def refusals() -> None:
    """Why a motion was refused."""
    _table(("`outcome`", "meaning"), [(f"`{name}`", text) for name, text in REFUSALS.items()], right=False)


def rules() -> None:
    """The topic rules, from the catalogue."""
    _table(("rule", "what it does", "messages go to", "from"), cloud_tables.rule_rows(), right=False)


def metrics() -> None:
    """The metrics of the functions, from the catalogue."""
    head = ("metric", "function", "unit", "statistic", "chart", "alarm")
    _table(head, cloud_tables.metric_rows(), right=False)


def alarms() -> None:
    """The alarms, from the catalogue."""
    head = ("alarm", "what happened", "goes off", "what to do")
    _table(head, cloud_tables.alarm_rows(), right=False)


def cost(name: str) -> None:
    """A table of the cost model: a robot's hour or year, what changes if, or fleets of several sizes."""
    usage = Usage()
    if name == "scale":
        rows = fleets(usage)
    else:
        print(f"List prices of {AS_OF}, {REGION}, in US dollars; one robot, {usage.rate_hz:g} Hz.\n")
        tables = {
            "hour": report.robot_hour,
            "month": report.month,
            "whatif": report.what_if,
            "year": report.robot_year,
        }
        rows = tables[name](usage)
    _table(rows.head, rows.body)


def month() -> None:
    """What the default deployment costs a month with a robot, all in, and what PubNub adds."""
    usage = Usage(robots=1, hours_per_day=2.0)
    driving, fixed = _month(usage)
    by_pubnub = replace(usage, live_transport=PUBNUB)
    plan = model.pubnub_mau_dollars_per_month(by_pubnub) or 0.0
    more = sum(_month(by_pubnub)) + plan - driving - fixed
    total = f"${driving + fixed:.0f} a month"
    print(f"With one robot that drives two hours a day, watched live, the default deployment costs {total}")
    print(
        f"on AWS at most, all in, at list prices: ${driving:.0f} for the driving with archive and analysis,"
    )
    print("the rest for itself, mostly for metrics and alarms.")
    print(f"Live over PubNub instead of AWS IoT adds ${more:.0f}, with PubNub's smallest plan.")


def _month(usage: Usage) -> tuple[float, float]:
    """AWS' dollars a month for the driving, and for the deployment itself."""
    driving = model.dollars_per_month(model.bill(usage), usage)
    return driving, sum(deployment_dollars_per_month(usage).values())


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
        print(f"\n## `iort-agent {command.name}`\n\n{command.meaning}\n")
        _table(("option", "meaning"), command.rows, right=False)


def errors() -> None:
    """The errors of the agent and of the station."""
    rows = []
    for module in (iort_agent.errors, iort_station.errors):
        for name, cls in vars(module).items():
            if isinstance(cls, type) and issubclass(cls, Exception):
                meaning = (cls.__doc__ or "").strip().splitlines()[0].replace("``", "`")
                rows.append((f"`{module.__name__}.{name}`", meaning))
    _table(("error", "meaning"), rows, right=False)


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
    sys.exit(main())
