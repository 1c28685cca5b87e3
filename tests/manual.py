"""The commands of `iort` and the examples in their help."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from typing import Any

import typer

from iort_station.cli.main import app


def _commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, verb in group.commands.items():
        command = verb.load() if hasattr(verb, "load") else verb
        if hasattr(command, "commands"):
            yield from _commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


# Every command, by its name, such as "robots add".
COMMANDS = dict(_commands(typer.main.get_command(app)))


def examples(name: str) -> list[str]:
    """The examples of a command, as `iort ...`."""
    return [line.strip() for line in (COMMANDS[name].epilog or "").splitlines() if line.startswith("  ")]


def parse(example: str) -> str:
    """The name of the command that an example calls; raises click's error if it is wrong."""
    words = shlex.split(example)[1:]
    name = next(name for n in (2, 1) if (name := " ".join(words[:n])) in COMMANDS)
    COMMANDS[name].make_context(name, words[len(name.split()) :])
    return name
