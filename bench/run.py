"""`make bench`: every table of the thesis, measured on one command.

    python -m bench.run [--only query,outage] [--target embedded|aws] [--out build/bench]

Writes report.md, report.html, report.json and the pictures into the folder. Exit status 1 if a target is
missed, 2 if a section could not be measured.
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
from rich.table import Table

from bench import machine, report
from bench.result import Section
from bench.sections import SECTIONS
from bench.target import AWS, EMBEDDED, Target, open_target
from contract import DEFAULT_NAMESPACE
from local.errors import LocalError
from station.errors import StationError

OUT = machine.ROOT / "build" / "bench"


def main() -> None:
    """Measure, write and say."""
    options = _options()
    console = Console()
    began = time.monotonic()
    here = machine.describe()

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:6.1f} s    {escape(text)}", highlight=False, style="dim")

    sections: list[Section] = []
    failed: list[str] = []
    try:
        with open_target(options.target, namespace=options.namespace, say=say) as target:
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
            report.write(options.out, sections, here, options.target)
    _show(console, sections)
    console.print(f"{options.out / 'report.html'}  after {time.monotonic() - began:.0f} s", highlight=False)
    if failed:
        console.print(f"not measured: {', '.join(failed)}", style="red")
        sys.exit(2)
    sys.exit(1 if any(r.reached is False for s in sections for r in s.ratios) else 0)


def _measure(key: str, target: Target, console: Console, sections: list[Section], failed: list[str]) -> None:
    """One section; one that fails does not take the others with it."""
    began = time.monotonic()

    def say(text: str) -> None:
        console.print(f"{time.monotonic() - began:8.1f} s  {escape(text)}", highlight=False, style="dim")

    try:
        section = SECTIONS[key](target, say)
    except Exception:  # noqa: BLE001 - whatever a section raises, the others are worth having
        console.print(traceback.format_exc(), style="red", markup=False, highlight=False)
        failed.append(key)
        return
    section.seconds = time.monotonic() - began
    sections.append(section)


def _show(console: Console, sections: list[Section]) -> None:
    rows = report.headline(sections)
    table = Table(title=rows.title, title_justify="left", title_style="bold")
    for i, name in enumerate(rows.head):
        table.add_column(name, justify="right" if i else "left")
    for row in rows.rows:
        table.add_row(*(cell.replace("**", "") for cell in row), style="red" if row[-1] == "**no**" else "")
    console.print(table)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make bench", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", type=_sections, default=list(SECTIONS), help=", ".join(SECTIONS))
    parser.add_argument("--target", choices=(EMBEDDED, AWS), default=EMBEDDED)
    parser.add_argument("--namespace", default=DEFAULT_NAMESPACE, help="the deployment's, with --target aws")
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
