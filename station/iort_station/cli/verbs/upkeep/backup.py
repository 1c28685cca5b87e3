"""`iort backup`: the kept cloud in one file, while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from iort_station.cli.console import tell
from iort_station.cli.options import AsJson, Force, State, running_state
from iort_station.cli.progress import bar
from iort_station.cli.words import examples, say

commands = typer.Typer()


@commands.command("backup", epilog=examples("backup cloud.tar"))
def backup_(
    context: typer.Context,
    file: Annotated[Path, typer.Argument(help="The archive to write.")],
    state: State = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Write the cloud of `make up` into one file: telemetry, files, robots, certificates. It goes on.

    Everything is of one moment. The file appears when it is whole. It has the cloud's private keys: only its
    owner can read it.
    """
    from iort_station.upkeep import backup  # noqa: PLC0415 - SQLite takes longer to load than TAB may take

    folder = running_state(context, state)
    say(f"of the cloud that is kept in {folder}")
    with bar("backup", backup.size_of(folder) if folder.exists() else None) as progress:
        made = backup.back_up(folder, file, force=force, progress=progress)
    facts = {"file": str(file), "bytes": made.size, "files": len(made.files), "state": str(folder)}
    tell(facts, f"{file}: {len(made.files):,} files, {made.size / 1e6:,.1f} MB, of {folder}", as_json=as_json)
