"""The options of `make up` and of the commands around it: make's words, and the flags behind them."""

from __future__ import annotations

import argparse
from pathlib import Path

from iort_station import kept
from local.settings import NO

_REMEMBERED = ("listen", "page", "power_cut", "ports")
_WORDS = "[LISTEN=address[,name...]] [PAGE=address[,name...]] [POWER_CUT=1] [PORTS=any]"


def parser(
    command: str, description: str, *, remembered: bool = False, more: str = ""
) -> argparse.ArgumentParser:
    """A parser of the option that every command has, the folder, and of those that a start remembers.
    ``more`` are further words of make."""
    words = ["make", command, "[STATE=folder]", *([_WORDS] if remembered else []), *([more] if more else [])]
    made = argparse.ArgumentParser(prog=f"make {command}", usage=" ".join(words), description=description)
    made.add_argument(
        "--state",
        type=lambda text: Path(text).expanduser().absolute(),
        default=kept.folder(),
        metavar="FOLDER",
        help="where the cloud is kept (default: %(default)s)",
    )
    if remembered:
        _add_remembered(made)
    return made


def _add_remembered(parser: argparse.ArgumentParser) -> None:
    network = f"an address of this machine, and names for it; remembered, until {NO}"
    parser.add_argument("--listen", metavar="HOSTS", help=f"open broker and files to a network: {network}")
    parser.add_argument("--page", metavar="HOSTS", help=f"open the page, with a password: {network}")
    parser.add_argument(
        "--power-cut",
        choices=["0", "1"],
        help="let what was acknowledged survive a power cut, too; remembered",
    )
    parser.add_argument(
        "--ports",
        choices=["any"],
        help="at the first start take any free ports and leave the usual ones to another cloud; remembered",
    )


def flags(options: argparse.Namespace) -> list[str]:
    """The options again, as `make up` in another process takes them."""
    found = ["--state", str(options.state)]
    for name in _REMEMBERED:
        if (value := getattr(options, name)) is not None:
            found += [f"--{name.replace('_', '-')}", value]
    return found
