"""`make bench`: every table of the thesis, and each other instrument of the project, by one command.

    python -m bench.run [--only query,outage] [--set NAME=VALUE ...] [--target embedded|aws] [--yes]
                        [--out build/bench]

Without --only it measures the tables of the thesis. Writes Markdown and JSON of each report into the
folder. Exit status 1 if a target is missed, 2 if a section could not be measured.

With --target aws it shows the cost and asks first. After Ctrl-C or a closed terminal it still restores every
setting and removes every resource of the bench.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console
from rich.markup import escape

from bench import report, sections
from bench.report import Section
from bench.sections import ALL, SECTIONS, Declared
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station.cloud import Cloud
from iort_station.cost.prices import AS_OF, REGION
from iort_station.errors import StationError
from local.processes import LocalError
from testkit import ROOT, machine
from testkit.command import confirm, wound_up
from testkit.target import AWS, EMBEDDED, Target, open_target
from testkit.waiting import InstrumentError

OUT = ROOT / "build" / "bench"


@dataclass
class Result:
    """What a run has measured, by report, and the sections that failed."""

    reports: dict[report.Report, list[Section]]
    failed: list[str]

    @property
    def sections(self) -> list[Section]:
        """Of all reports."""
        return [section for each in self.reports.values() for section in each]

    @property
    def status(self) -> int:
        """The exit status."""
        missed = any(ratio.reached is False for section in self.sections for ratio in section.ratios)
        return 2 if self.failed else int(missed)


def main() -> None:
    """Measure the sections, write the reports and print the headline."""
    try:
        run(_options())
    except KeyboardInterrupt:
        sys.exit(130)


def run(options: argparse.Namespace, cloud: Cloud | None = None) -> None:
    """Measure on ``cloud``, or without it on the cloud of the options and the environment."""
    console, began, here = Console(), time.monotonic(), machine.describe()
    declared = {key: sections.load(key) for key in options.only}
    values = sections.values(declared, options.values)
    result = Result({}, [])

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:6.1f} s    {escape(text)}", highlight=False, style="dim")

    try:
        with wound_up(console), ExitStack() as stack:
            target: Target | None = None
            if any(each.cloud for each in declared.values()):
                target = stack.enter_context(
                    open_target(options.target, namespace=options.namespace, cloud=cloud, say=say)
                )
                if target.kind == AWS and not options.yes:
                    confirm(console, _announced(declared), StationError)
            for number, (key, each) in enumerate(declared.items(), 1):
                say(f"[{number} of {len(declared)}] {key}")
                _measure(key, each, target, values[key], console, result)
    except (LocalError, StationError, BotoCoreError, ClientError) as error:
        console.print(f"bench: {error}", style="red", markup=False)
        sys.exit(2)
    finally:
        for kind, measured in result.reports.items():
            report.write(options.out, measured, here, options.target, kind)
    report.headline(result.sections).show(console)
    written = ", ".join(f"{options.out / kind.name}.md" for kind in result.reports)
    console.print(f"{written}  after {time.monotonic() - began:.0f} s", highlight=False, soft_wrap=True)
    if result.failed:
        console.print(f"not measured: {', '.join(result.failed)}", style="red")
    sys.exit(result.status)


def _announced(declared: dict[str, Declared]) -> str:
    dollars = {key: each.dollars for key, each in declared.items() if each.dollars}
    parts = ", ".join(f"{key} {usd:.3f}" for key, usd in dollars.items())
    return (
        f"This costs about ${sum(dollars.values()):.2f} in your account ({parts}) at the list prices of "
        f"{AS_OF} in {REGION}, more where the telemetry table is large, and PubNub's transactions. Robots, "
        "certificates, functions and a table named bench-... are made and removed again."
    )


def _measure(  # noqa: PLR0917 - one caller
    key: str,
    each: Declared,
    target: Target | None,
    values: dict[str, Any],
    console: Console,
    result: Result,
) -> None:
    """Measure one section; a failure does not stop the others."""
    began = time.monotonic()

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:8.1f} s  {escape(text)}", highlight=False, style="dim")

    try:
        measured = each.measure(target, say, **values)
    except Exception as error:  # noqa: BLE001 - any error of a section must not stop the others
        why = f"{key}: {error}" if isinstance(error, InstrumentError) else traceback.format_exc()
        console.print(why, style="red", markup=False, highlight=False)
        result.failed.append(key)
        return
    several = [measured] if isinstance(measured, Section) else list(measured)
    several[0].seconds = time.monotonic() - began
    result.reports.setdefault(each.report, []).extend(several)
    if key not in SECTIONS:
        for table in (table for section in several for table in section.tables):
            table.show(console)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="make bench",
        description=(__doc__ or "").splitlines()[0],
        # It loads every section, and with one of them the CDK.
        epilog=sections.manual() if {"-h", "--help"} & set(sys.argv) else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", type=_sections, default=list(SECTIONS), help=f"some of {', '.join(ALL)}")
    parser.add_argument("--set", dest="values", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--target", choices=(EMBEDDED, AWS), default=EMBEDDED)
    parser.add_argument("--namespace", default=DEFAULT_NAMESPACE, help="the deployment's, with --target aws")
    parser.add_argument("--yes", action="store_true", help="with --target aws: spend without asking")
    parser.add_argument("--out", type=Path, default=OUT, metavar="FOLDER")
    options = parser.parse_args()
    try:
        sections.values({key: sections.load(key) for key in options.only}, options.values)
    except ValueError as error:
        parser.error(str(error))
    return options


def _sections(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in ALL]
    if unknown or not names:
        raise argparse.ArgumentTypeError(f"ONLY={text}: allowed is some of {', '.join(ALL)}")
    return [key for key in ALL if key in names]


if __name__ == "__main__":
    main()
