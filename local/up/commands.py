"""The commands around `make up`, `down` and `up-password`, and the options that they share with it."""

from __future__ import annotations

import argparse
import getpass
import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from iort_station import kept
from iort_station.errors import StationError
from iort_station.kept import owner
from iort_station.page.password import LEAST_CHARACTERS, Password
from local.processes import LocalError
from local.state import NO, StateFolder

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


# `make down`: stop the cloud of `make up`, and wait until it has ended.

_ENDS_S = 60.0
_POLL_S = 0.1


def down() -> None:
    """Stop it. The exit status is 0 if it has ended, and 1 otherwise."""
    folder = parser("down", "Stop the cloud of `make up`; it is kept.").parse_args().state
    try:
        stopped = stop(folder)
    except LocalError as error:
        sys.exit(f"down: {error}")
    print(f"stopped; everything is kept in {folder}" if stopped else f"nothing is up in {folder}")  # noqa: T201 - as `make up`


def stop(folder: Path) -> bool:
    """Stop the cloud of a folder; whether one was up. Raises `LocalError` if it does not end."""
    try:
        pid = owner(folder)
    except PermissionError as error:
        raise LocalError(f"{folder} is another user's, who must stop its cloud: {error}") from error
    if pid is None:
        return False
    # It may end by itself meanwhile.
    with suppress(ProcessLookupError):
        try:
            os.kill(pid, signal.SIGTERM)
        except PermissionError as error:
            raise LocalError(f"process {pid} is another user's, who must stop it") from error
    deadline = time.monotonic() + _ENDS_S
    while owner(folder) is not None:
        if time.monotonic() > deadline:
            raise LocalError(f"process {pid} has not ended in {_ENDS_S:.0f} s")
        # It is no child of ours, so nothing tells its end.
        time.sleep(_POLL_S)
    return True


# `make up-password`: set the password of the page in the network; whoever is logged in must log in again.


def password() -> None:
    """Ask for a password twice, and keep its hash."""
    folder = parser("up-password", "Set the password of the page in the network.").parse_args().state
    try:
        _change(folder)
    except (LocalError, StationError, EOFError) as error:
        sys.exit(f"password: {error or 'nothing was typed'}")


def _change(folder: Path) -> None:
    StateFolder(folder, kept=True).prepare()
    new = getpass.getpass(f"New password, at least {LEAST_CHARACTERS} characters: ")
    if getpass.getpass("Again: ") != new:
        raise LocalError("the two passwords must be the same")
    Password(folder).set(new)


if __name__ == "__main__":
    {"down": down, "password": password}[sys.argv.pop(1)]()
