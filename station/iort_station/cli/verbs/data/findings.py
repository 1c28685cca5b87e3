"""`iort findings`: what the analysis has found."""

from __future__ import annotations

from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from iort_contract.catalog.analysis import KINDS
from iort_contract.messages.analysis import AnalysedDrive, Estimate, Finding, encode_analysed, encode_finding
from iort_contract.page import history_link
from iort_station.cli import completion
from iort_station.cli.console import errors, out, print_json
from iort_station.cli.options import AsJson, When, ranged
from iort_station.cli.words import examples
from iort_station.data import findings as stored
from iort_station.fleet import registry
from iort_station.times import between, iso_s, stamped

commands = typer.Typer()
_STYLES = {"serious": "bold red", "warning": "yellow", "info": ""}


@commands.command("findings", epilog=examples("findings car7", "findings car7 --drives", "findings --json"))
@ranged
def findings(
    context: typer.Context,
    when: When,
    robot: Annotated[
        str | None,
        typer.Argument(help="The robot. Default: all.", autocompletion=completion.robots, show_default=False),
    ] = None,
    drives: Annotated[
        bool, typer.Option("--drives", help="List the analysed drives, and what could not be computed.")
    ] = False,
    count: Annotated[int, typer.Option(min=1, max=10_000, help="The most to list; the newest.")] = 50,
    page: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="The page for the links, such as http://localhost:8080/. Default: the embedded cloud's.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List what the analysis found about drives, the newest first, with its evidence and what to do.

    An interval holds the truth in 90 of 100 cases. The link opens the page's history at the evidence. Without
    a known page it begins with #: `iort dashboard` serves the page that it belongs to.
    """
    cloud, within = context.obj.cloud(), when.range()
    if drives:
        analysed = stored.drives(cloud, robot, within.start_us, within.end_us, most=count)
        if as_json:
            print_json([_drive_as_json(one) for one in analysed])
        for one in () if as_json else analysed:
            _show_drive(one)
        found: list[Any] = list(analysed)
    else:
        # The embedded cloud serves one.
        page = page or cloud.page or ""
        page += "/" if page and not page.endswith("/") else ""
        found = stored.findings(cloud, robot, within.start_us, within.end_us, most=count)
        if as_json:
            print_json([_as_json(one, page) for one in found])
        for finding in () if as_json else found:
            _show(finding, page)
    if not found and robot is not None:
        registry.get(cloud, robot)
    if not found and not as_json:
        what = "no drive in this range is analysed" if drives else "nothing was found in this range"
        errors.print(f"{what}; `iort analyse` looks now")


def _show(one: Finding, page: str) -> None:
    kind = KINDS.get(one.kind)
    out.print(
        Text.assemble(
            f"{iso_s(one.from_us)}  {one.drive.robot}  ",
            (f"{one.severity}: {one.text}", _STYLES.get(one.severity, "")),
        ),
        soft_wrap=True,
    )
    rows = Table(box=None, show_header=False, padding=(0, 1, 0, 0), pad_edge=True)
    rows.add_column(width=8)
    rows.add_column(overflow="fold")
    if one.effect is not None:
        rows.add_row("effect", _interval(one.effect))
    if one.baseline is not None:
        rows.add_row("before", _interval(one.baseline))
    if one.q is not None:
        rows.add_row("false", f"at most {one.q:.2g} of such findings")
    if kind is not None:
        rows.add_row("to do", kind.action)
    out.print(rows)
    # In one piece, to be clicked or copied.
    out.print(Text(f" evidence {history_link(page, one)}"), soft_wrap=True)


def _as_json(finding: Finding, page: str) -> dict[str, Any]:
    evidence = between({"from_us": finding.from_us, "to_us": finding.to_us})
    start = stamped("start", finding.drive.start_us)
    return {**encode_finding(finding), **start, **evidence, "link": history_link(page, finding)}


def _drive_as_json(analysed: AnalysedDrive) -> dict[str, Any]:
    content = encode_analysed(analysed)
    del content["job"]
    return content | {
        **stamped("start", analysed.drive.start_us),
        **stamped("end", analysed.end_us),
        **stamped("analysed", analysed.analysed_us or None),
    }


def _interval(estimate: Estimate) -> str:
    factor, unit = (100, "%") if estimate.unit == "1" else (1, estimate.unit)
    value, low, high = (each * factor for each in (estimate.value, estimate.low, estimate.high))
    return f"{value:.4g} {unit} ({low:.4g} to {high:.4g})"


def _show_drive(one: AnalysedDrive) -> None:
    lasted_s = (one.end_us - one.drive.start_us) / 1e6
    out.print(f"{iso_s(one.drive.start_us)}  {one.drive.robot}  {lasted_s:,.0f} s, {one.samples:,} samples")
    rows = Table(box=None, show_header=False, padding=(0, 1, 0, 0), pad_edge=True)
    rows.add_column()
    rows.add_column(overflow="fold")
    for name, estimate in one.estimates.items():
        rows.add_row(name, _interval(estimate))
    for kind, samples in one.repairs.items():
        rows.add_row(f"repaired: {kind}", f"{samples:,} samples")
    names_of: dict[str, list[str]] = {}
    for name, reason in one.missing.items():
        names_of.setdefault(reason, []).append(name)
    for reason, names in names_of.items():
        rows.add_row("missing", f"{', '.join(names)}: {reason}", style="yellow")
    out.print(rows)
