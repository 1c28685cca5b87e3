"""What TAB offers: the names of robots, streams, fields and files.

The shell waits for TAB, and a cloud takes a second to answer. So names are kept in a file, in the user's
cache. A process in the background asks the cloud, and writes the file for the next TAB. Only the first TAB
waits for it. TAB prints no error: an unreachable cloud offers nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from iort_contract.catalog.derived import DERIVED
from iort_station.cli.cloud_options import CloudOptions
from iort_station.output import cache, whole

if TYPE_CHECKING:
    from iort_station.cloud import Cloud

# How long names are offered before the cloud is asked again, and how long the first TAB waits.
_FRESH_S, _PATIENCE_S = 30.0, 3.0
_NEWEST_FILES = 200
# Set in the process in the background.
_ASKS = "IORT_COMPLETION_ASKS"
Ask = Callable[["Cloud"], list[str]]


def robots(ctx: typer.Context, incomplete: str) -> list[str]:
    """The registered robots."""

    def ask(cloud: Cloud) -> list[str]:
        from iort_station.fleet import registry  # noqa: PLC0415 - only the background asks

        return sorted(str(row["robot"]) for row in registry.listed(cloud))

    return _matching(_names(ctx, ask, "robots"), incomplete)


def streams(ctx: typer.Context, incomplete: str) -> list[str]:
    """The streams of the robot that is named before."""
    robot = _robot(ctx)

    def ask(cloud: Cloud) -> list[str]:
        from iort_station.data import inventory  # noqa: PLC0415 - as above

        return inventory.streams_of(cloud, robot)

    return _matching(_names(ctx, ask, "streams", robot), incomplete)


def fields(ctx: typer.Context, incomplete: str) -> list[str]:
    """The fields of the stream that is named before, and the derived ones; after a comma another one."""
    robot, stream = _robot(ctx), str(ctx.params.get("stream"))

    def ask(cloud: Cloud) -> list[str]:
        from iort_station.data import inventory  # noqa: PLC0415 - as above

        return sorted({*inventory.newest_block(cloud, robot, stream).columns, *DERIVED})

    before, comma, begun = incomplete.rpartition(",")
    known = set(_names(ctx, ask, "fields", robot, stream)) - set(before.split(","))
    return [f"{before}{comma}{name}" for name in _matching(sorted(known), begun)]


def files(ctx: typer.Context, incomplete: str) -> list[str]:
    """The newest files of the robot that is named before."""
    robot = _robot(ctx)

    def ask(cloud: Cloud) -> list[str]:
        from iort_station.fleet import files as stored  # noqa: PLC0415 - as above

        found = dict.fromkeys(one.name for one in stored.listed(cloud, robot))
        return list(found)[-_NEWEST_FILES:]

    return _matching(_names(ctx, ask, "files", robot), incomplete)


def _robot(ctx: typer.Context) -> str:
    return str(ctx.params.get("robot") or ctx.params.get("name"))


def _matching(names: list[str], begun: str) -> list[str]:
    return [name for name in names if name.startswith(begun)]


def _names(ctx: typer.Context, ask: Ask, *key: str) -> list[str]:
    """The names that are kept under ``key``; older ones are asked for in the background."""
    with suppress(Exception):
        given = ctx.find_root().params
        options = CloudOptions(
            *(given[name] for name in ("namespace", "profile", "region", "local", "embedded"))
        )
        path = _kept_at(options, *key)
        if _ASKS in os.environ:
            _keep(path, ask(options.cloud()))
            return []
        found = _kept(path)
        if not path.exists() or not 0 <= time.time() - path.stat().st_mtime < _FRESH_S:
            # Also a cloud that does not answer is asked only so often.
            _keep(path, found)
            asking = _ask_in_background()
            if not found:
                asking.wait(_PATIENCE_S)
                return _kept(path)
        return found
    return []


def _kept(path: Path) -> list[str]:
    return list(json.loads(path.read_text())) if path.exists() else []


def _keep(path: Path, names: list[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole(path, force=True) as part:
        part.write_text(json.dumps(names))


def _ask_in_background() -> subprocess.Popen[Any]:
    """Run this very completion in a process of its own, which outlives this one."""
    return subprocess.Popen(
        [sys.executable, "-m", "iort_station.cli.main"],
        env={**os.environ, _ASKS: "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _kept_at(options: CloudOptions, *key: str) -> Path:
    """The file of the names; another cloud has other ones."""
    embedded = options.file()
    chosen = [os.environ.get(name) for name in ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION")]
    began = embedded.stat().st_mtime if embedded and embedded.exists() else None
    text = repr((options, embedded, began, chosen, key))
    return cache(os.environ) / "names" / f"{hashlib.sha256(text.encode()).hexdigest()[:24]}.json"
