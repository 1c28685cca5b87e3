"""The verbs of `iort` as commands that are imported when they are used.

So `iort --help` and the completion of a verb's name import no verb, and a verb imports only what it needs.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from iort_station.cli import verbs


class Verb(TyperCommand):
    """A verb: its name and its line of help, and the command itself as soon as it is used."""

    def __init__(self, file: str, summary: str) -> None:
        super().__init__(file.rpartition(".")[2].replace("_", "-"), short_help=summary)
        self._module = f"{verbs.__name__}.{file}"

    def load(self) -> Any:
        # A group of its own gives the command its name, and no options for completion.
        group = typer.Typer(add_completion=False, rich_markup_mode=None)
        group.add_typer(import_module(self._module).commands)
        return typer.main.get_group(group).commands[str(self.name)]

    def make_context(self, info_name: str | None, args: list[str], *given: Any, **named: Any) -> Any:
        """The context of the command, which then takes the verb's place."""
        if named.get("resilient_parsing") and args and args[-1].startswith("-"):
            # TAB asks for the value of this option; without it the parser would give up, and know no robot.
            args = args[:-1]
        return self.load().make_context(info_name, args, *given, **named)


class Verbs(TyperGroup):
    """Every verb of the list."""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        for file, summary in verbs.VERBS.items():
            self.add_command(Verb(file, summary))
