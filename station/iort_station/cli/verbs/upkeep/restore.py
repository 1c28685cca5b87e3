"""`iort restore`: a kept cloud from its backup."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, DryRun, State, state_folder
from iort_station.cli.progress import bar
from iort_station.cli.words import examples, say
from iort_station.times import iso_s

commands = typer.Typer()


@commands.command("restore", epilog=examples("restore cloud.tar --dry-run"))
def restore_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The archive of `iort backup`.")],
    state: State = None,
    force: Annotated[
        bool, typer.Option("--force", help="Also where a state is already; that one is renamed, and kept.")
    ] = False,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Make the state folder of a cloud from its backup; `make up` then starts it.

    Every file is compared with its hash first. The folder appears when it is whole, and never where a cloud
    runs. --dry-run only reads the archive, and says whether it is good.
    """
    from iort_station.upkeep import backup  # noqa: PLC0415 - as in `iort backup`

    folder, earlier = state_folder(context, state), None
    if not dry_run:
        say(f"to {folder}, for `make up`")
    with bar("restore", file.stat().st_size) as progress:
        if dry_run:
            manifest = backup.verify(file, progress)
        else:
            manifest, earlier = backup.restore(file, folder, force=force, progress=progress)
    made = iso_s(round(manifest.made_s * 1e6))
    text = f"{file}: good, {len(manifest.files):,} files, {manifest.size / 1e6:,.1f} MB, of {made}"
    if not dry_run:
        text += f"; restored to {folder}" + (f", where the earlier state is {earlier} now" if earlier else "")
    facts = {
        "file": str(file),
        "made": made,
        "bytes": manifest.size,
        "files": len(manifest.files),
        "state": None if dry_run else str(folder),
        "earlier": None if earlier is None else str(earlier),
    }
    tell(facts, text, as_json=as_json)
