"""New links to a page that runs: each lets one more browser act, for the user who serves the page.

A page's server listens on a Unix socket in a folder that only its user may enter, so no key is in a file, and
the system says who may ask. The folder also tells which pages this user serves; a killed server leaves a
socket that nobody answers.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from iort_station.errors import StationError, UsageError

COMMAND = "iort invite"
_ENDING = ".sock"
_ANSWER_S = 5.0
_MOST_BYTES = 4096
# An address of a Unix socket is shorter than this on every system.
_MOST_PATH = 100


class ServedPage(NamedTuple):
    """A page of this user that runs: its port, and its address."""

    port: int
    url: str
    socket: Path


@contextmanager
def listening(folder: Path, port: int) -> Iterator[socket.socket]:
    """The socket at which the page of this port gives invitations, until the block ends."""
    folder.mkdir(parents=True, exist_ok=True)
    entered = folder.stat()
    if entered.st_uid != os.geteuid():
        raise StationError(f"{folder} must be yours, got user {entered.st_uid}'s")
    if stat.S_IMODE(entered.st_mode) != 0o700:
        folder.chmod(0o700)
    path = folder / f"{port}{_ENDING}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
        with suppress(FileNotFoundError):
            # Of a killed server: this one has the port now.
            path.unlink()
        with _short(path) as address:
            door.bind(address)
        try:
            path.chmod(0o600)
            door.listen()
            yield door
        finally:
            path.unlink(missing_ok=True)


async def answer(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, url: str, invite: Callable[[], str]
) -> None:
    """Answer a connection: with the page's address, and with an invitation if that is asked for."""
    try:
        request = await asyncio.wait_for(reader.readline(), _ANSWER_S)
        content = {"url": url, **({"address": invite()} if request.strip() == b"invite" else {})}
        writer.write(json.dumps(content).encode())
        await writer.drain()
    except (OSError, ValueError, asyncio.TimeoutError):
        # Whoever asked has gone.
        return
    finally:
        writer.close()


def served(folder: Path) -> list[ServedPage]:
    """The pages of this user that run, by their ports."""
    paths = [path for path in folder.glob(f"*{_ENDING}") if path.stem.isdecimal()]
    return sorted(
        ServedPage(int(path.stem), content["url"], path)
        for path in paths
        if (content := _ask(path, "url")) is not None
    )


def invite(folder: Path, port: int | None = None) -> tuple[ServedPage, str]:
    """A page, and a new invitation to it. Raises `StationError` without such a page, and `UsageError` if
    there are several and no ``port`` says which."""
    pages = served(folder)
    if not pages:
        raise StationError(
            "you serve no page on this machine that a link could let drive: `iort dashboard`, `make demo` or "
            "`make up` does"
        )
    shown = ", ".join(page.url for page in pages)
    if port is None and len(pages) > 1:
        raise UsageError(f"several pages are served: {shown}; choose one, such as --port {pages[0].port}")
    chosen = next((page for page in pages if port in {None, page.port}), None)
    if chosen is None:
        raise UsageError(f"--port must be that of a page of yours, got {port}; there is {shown}")
    content = _ask(chosen.socket, "invite")
    if content is None:
        raise StationError(f"the page {chosen.url} has ended")
    return chosen, content["address"]


def _ask(path: Path, what: str) -> dict[str, str] | None:
    """What a page's server tells; None if it has ended."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
            door.settimeout(_ANSWER_S)
            with _short(path) as address:
                door.connect(address)
            door.sendall(f"{what}\n".encode())
            received = b""
            while (part := door.recv(_MOST_BYTES)) and len(received) < _MOST_BYTES:
                received += part
        content: dict[str, str] = json.loads(received)
    except (OSError, ValueError):
        return None
    return content


@contextmanager
def _short(path: Path) -> Iterator[str]:
    """The path as a Unix socket's address, which must be short."""
    if len(os.fsencode(path)) <= _MOST_PATH:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Linux alone has this; elsewhere the folder of a user is short.
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)
