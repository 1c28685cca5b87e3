"""`make down`: stop the cloud of `make up`, and wait until it has ended."""

from __future__ import annotations

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from iort_station.kept import owner
from local.errors import LocalError
from local.up import options

_ENDS_S = 60.0
_POLL_S = 0.1


def main() -> None:
    """Stop it. The exit status is 0 if it has ended, and 1 otherwise."""
    folder = options.parser("down", "Stop the cloud of `make up`; it is kept.").parse_args().state
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


if __name__ == "__main__":
    main()
