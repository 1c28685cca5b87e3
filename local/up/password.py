"""`make up-password`: set the password of the page in the network; whoever is logged in must log in again."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path

from local.errors import LocalError
from local.state import StateFolder
from local.up import options
from local.up.login import LEAST_CHARACTERS, Password


def main() -> None:
    """Ask for a password twice, and keep its hash."""
    folder = options.parser("up-password", "Set the password of the page in the network.").parse_args().state
    try:
        _change(folder)
    except (LocalError, EOFError) as error:
        sys.exit(f"password: {error or 'nothing was typed'}")


def _change(folder: Path) -> None:
    StateFolder(folder, kept=True).prepare()
    new = getpass.getpass(f"New password, at least {LEAST_CHARACTERS} characters: ")
    if getpass.getpass("Again: ") != new:
        raise LocalError("the two passwords must be the same")
    Password(folder).set(new)


if __name__ == "__main__":
    main()
