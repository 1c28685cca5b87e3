"""`iort-agent upload`: uploads files at once, over a connection of its own."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path, PurePath
from typing import Iterator, NamedTuple, Sequence

from iort_agent.common.logs import set_up
from iort_agent.common.threads import SystemClock
from iort_agent.config import Config
from iort_agent.errors import NotRunningError, UploadError
from iort_agent.files.file import read
from iort_agent.files.upload import Uploader, make_uploader
from iort_agent.mqtt.rate_limiter import RateLimiter
from iort_agent.mqtt.uplink import Link, Uplink
from iort_agent.runtime import make_uplink
from iort_agent.status import process_at

_CONNECT_S = 30.0
_LOOK_S = 0.05


class Result(NamedTuple):
    """The outcome for one file: its key in the bucket, or an error."""

    path: Path
    key: str | None = None
    error: str | None = None


def upload_files(config: Config, paths: Sequence[Path], *, status_socket: Path) -> Iterator[Result]:
    """Upload the files one after the other, and show progress on a terminal.

    Raises `UploadError` without a connection, and while an agent runs, whose connection this would end.
    """
    _refuse_beside_agent(config, status_socket)
    set_up("warning")
    clock, stop = SystemClock(), threading.Event()
    uplink = make_uplink(config, clock)
    link = Link(config.robot, config.namespace, uplink, clock, RateLimiter(clock))
    uploader = make_uploader(link, root_ca=config.root_ca, rate_kb_s=config.files.rate_kb_s)
    before = signal.signal(signal.SIGINT, lambda _number, _frame: stop.set())
    uplink.start()
    try:
        _wait_ready(uploader, uplink, clock, stop)
        for path in paths:
            yield _upload(uploader, path, stop)
    finally:
        uplink.stop(5.0)
        signal.signal(signal.SIGINT, before)


def _upload(uploader: Uploader, path: Path, stop: threading.Event) -> Result:
    size, shows = 0, sys.stderr.isatty()

    def show(there: int) -> None:
        """Overwrite a line on a terminal."""
        if shows:
            percent = 100 * there // max(1, size)
            print(f"\r{path.name}  {percent:3d} % of {size:,} bytes", end="", file=sys.stderr)

    try:
        # The user may name a link.
        file = Path(os.path.realpath(path))
        local = read(file.parent, PurePath(file.name), stop=stop)
        size = local.look.size
        return Result(path, key=uploader.upload(local, stop, show))
    except UploadError as error:
        return Result(path, error=str(error))
    finally:
        if shows and size:
            print(file=sys.stderr)


def _wait_ready(uploader: Uploader, uplink: Uplink, clock: SystemClock, stop: threading.Event) -> None:
    until = clock.monotonic() + _CONNECT_S
    while not uploader.ready():
        if stop.is_set() or clock.monotonic() > until:
            why = uplink.status().last_error or "no answer"
            raise UploadError(f"no connection to the cloud: {why}", again_s=None)
        # The connection notifies only handlers that were registered before it started.
        clock.wait(stop, _LOOK_S)


def _refuse_beside_agent(config: Config, status_socket: Path) -> None:
    try:
        process = process_at(status_socket)
    except NotRunningError:
        return
    folder = config.files.folder
    what = f"copy the files into {folder}, and it uploads them" if folder else "stop it, or set files.folder"
    raise UploadError(
        f"an agent is running with this configuration (process {process}), and a robot has one "
        f"connection: {what}",
        again_s=None,
    )
