"""`make bench`: every table of the thesis, measured on one command.

    python -m bench.run [--only query,outage] [--target embedded|aws] [--yes] [--out build/bench]

Writes report.md, report.json and the pictures into the folder. Exit status 1 if a target is
missed, 2 if a section could not be measured.

With --target aws it shows the cost and asks first. After Ctrl-C or a closed terminal it still restores every
setting and removes every resource of the bench.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from pathlib import Path

from botocore.exceptions import BotoCoreError, ClientError
from rich.console import Console
from rich.markup import escape

from bench.report import spending, writer
from bench.report.result import Section
from bench.sections import SECTIONS
from iort_contract.limits import DEFAULT_NAMESPACE
from iort_station.cloud import Cloud
from iort_station.cost.prices import AS_OF, REGION
from iort_station.errors import StationError
from local.processes import LocalError
from testkit import ROOT, machine
from testkit.command import confirm, wound_up
from testkit.target import AWS, EMBEDDED, Target, open_target

OUT = ROOT / "build" / "bench"


def main() -> None:
    """Measure the sections, write the report and print its headline."""
    try:
        run(_options())
    except KeyboardInterrupt:
        sys.exit(130)


def run(options: argparse.Namespace, cloud: Cloud | None = None) -> None:
    """Measure on ``cloud``, or without it on the cloud of the options and the environment."""
    console = Console()
    began = time.monotonic()
    here = machine.describe()

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:6.1f} s    {escape(text)}", highlight=False, style="dim")

    sections: list[Section] = []
    failed: list[str] = []
    try:
        with (
            wound_up(console),
            open_target(options.target, namespace=options.namespace, cloud=cloud, say=say) as target,
        ):
            dollars = spending.estimate(target.cloud, options.only) if target.kind == AWS else {}
            if dollars and not options.yes:
                confirm(console, _announced(dollars), StationError)
            for number, key in enumerate(options.only, 1):
                console.print(
                    f"{time.monotonic() - began:6.1f} s  [bold]{key}[/]  ({number} of {len(options.only)})",
                    highlight=False,
                )
                _measure(key, target, console, sections, failed)
    except (LocalError, StationError, BotoCoreError, ClientError) as error:
        console.print(f"bench: {error}", style="red", markup=False)
        sys.exit(2)
    finally:
        if sections:
            writer.write(options.out, sections, here, options.target)
    writer.headline(sections).show(console)
    console.print(f"{options.out / 'report.md'}  after {time.monotonic() - began:.0f} s", highlight=False)
    if failed:
        console.print(f"not measured: {', '.join(failed)}", style="red")
        sys.exit(2)
    sys.exit(1 if any(r.reached is False for s in sections for r in s.ratios) else 0)


def _announced(dollars: dict[str, float]) -> str:
    parts = ", ".join(f"{key} {usd:.3f}" for key, usd in dollars.items())
    return (
        f"This costs about ${sum(dollars.values()):.2f} in your account ({parts}) at the list prices of "
        f"{AS_OF} in {REGION}, and PubNub's transactions. Robots, certificates, functions and a table named "
        "bench-... are made and removed again; utilisation changes Lambda 1's memory and puts it back."
    )


def _measure(key: str, target: Target, console: Console, sections: list[Section], failed: list[str]) -> None:
    """Measure one section; a failure does not stop the others."""
    began = time.monotonic()

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:8.1f} s  {escape(text)}", highlight=False, style="dim")

    try:
        section = SECTIONS[key](target, say)
    except Exception:  # noqa: BLE001 - any error of a section must not stop the others
        console.print(traceback.format_exc(), style="red", markup=False, highlight=False)
        failed.append(key)
        return
    section.seconds = time.monotonic() - began
    sections.append(section)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make bench", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", type=_sections, default=list(SECTIONS), help=", ".join(SECTIONS))
    parser.add_argument("--target", choices=(EMBEDDED, AWS), default=EMBEDDED)
    parser.add_argument("--namespace", default=DEFAULT_NAMESPACE, help="the deployment's, with --target aws")
    parser.add_argument("--yes", action="store_true", help="with --target aws: spend without asking")
    parser.add_argument("--out", type=Path, default=OUT, metavar="FOLDER")
    return parser.parse_args()


def _sections(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in SECTIONS]
    if unknown or not names:
        raise argparse.ArgumentTypeError(f"ONLY={text}: allowed is some of {', '.join(SECTIONS)}")
    return [key for key in SECTIONS if key in names]


if __name__ == "__main__":
    main()
