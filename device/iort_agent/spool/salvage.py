"""A new queue file, made of what can still be read of a damaged one."""

from __future__ import annotations

import contextlib
import datetime as dt
import sqlite3
from pathlib import Path
from typing import Callable, Collection, NamedTuple

from iort_agent.spool.file import SUFFIXES, SpoolFile, read_batches
from iort_agent.spool.interface import Dropped, Entry
from iort_contract.messages.batch import RunEnd

_SET_ASIDE_KEPT = 3
_GROUP = 256


def is_damage(error: Exception) -> bool:
    """Whether the file's content is at fault. A disk that is full, read-only or failing raises
    `sqlite3.OperationalError`, and so does a file that another program has locked."""
    return isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError)


class Salvage(NamedTuple):
    """Where a damaged file is now, what was saved, and what is known to be lost."""

    aside: Path | None
    saved: Dropped
    lost: Dropped


def rebuild(
    path: Path,
    damaged: SpoolFile | None,
    gone: Collection[int],
    *,
    connect: Callable[[Path], SpoolFile],
    now_us: int,
) -> Salvage:
    """Put a new file at the path, with what can be read of the damaged one, and set that one aside.

    ``damaged`` is the file if it is open; it may have been removed. The batches ``gone`` are left out.
    """
    new = rebuilt(path)
    _remove(new)
    source = damaged.connection if damaged is not None else sqlite3.connect(str(path))
    fresh = connect(new)
    try:
        saved, lost = _copy(source, fresh, gone)
        fresh.close()
    finally:
        fresh.abandon()
        if damaged is None:
            source.close()
    aside = _set_aside(path, now_us) if path.exists() else None
    put_in_place(path)
    return Salvage(aside, saved, lost)


def rebuilt(path: Path) -> Path:
    """The name of a new file until it is complete. A kill may leave it alone there."""
    return path.with_name(f"{path.name}.new")


def put_in_place(path: Path) -> None:
    """Give the new file its name. The log of a file that was removed must not stay: SQLite would write it
    into the new one."""
    for suffix in SUFFIXES[1:]:
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").unlink()
    rebuilt(path).replace(path)


def _set_aside(path: Path, now_us: int) -> Path:
    """Rename the file, with its log; only the newest few of those set aside are kept."""
    now = dt.datetime.fromtimestamp(now_us / 1_000_000, dt.timezone.utc)
    aside = path.with_name(f"{path.name}.corrupt-{now:%Y%m%dT%H%M%S.%fZ}")
    # The log last: without it the database may lack batches, and a kill would leave it in its place.
    for suffix in SUFFIXES:
        with contextlib.suppress(FileNotFoundError):
            Path(f"{path}{suffix}").replace(f"{aside}{suffix}")
    files = [str(file) for file in path.parent.glob(f"{path.name}.corrupt-*")]
    ours = {file[:-4] if file.endswith(SUFFIXES[1:]) else file for file in files}
    for old in sorted(ours)[:-_SET_ASIDE_KEPT]:
        _remove(Path(old))
    return aside


def _remove(path: Path) -> None:
    for suffix in SUFFIXES:
        with contextlib.suppress(OSError):
            Path(f"{path}{suffix}").unlink()


def _copy(source: sqlite3.Connection, into: SpoolFile, gone: Collection[int]) -> tuple[Dropped, Dropped]:
    """Copy what is still good; what was saved, and what is known to be lost."""
    with contextlib.suppress(sqlite3.Error):
        for stream, boot, seq in source.execute("SELECT stream, boot, last_seq FROM runs ORDER BY rowid"):
            into.commit([], ends={stream: RunEnd(boot, seq)})
    saved, lost = [], []
    group: list[Entry] = []
    for entry_id, samples in sorted(_known(source).items()):
        if entry_id in gone:
            continue
        try:
            (entry,) = read_batches(source, "id = ?", (entry_id,))
        except (sqlite3.Error, ValueError):
            lost.append(samples)
            continue
        saved.append(samples)
        group.append(entry)
        if len(group) >= _GROUP:
            into.commit(group)
            group = []
    into.commit(group)
    return Dropped(len(saved), sum(saved)), Dropped(len(lost), sum(lost))


def _known(db: sqlite3.Connection) -> dict[int, int]:
    """The ids that either the table or its index still knows, and the samples."""
    known: dict[int, int] = {}
    for source in ("batches NOT INDEXED", "batches INDEXED BY sizes"):
        for order in ("ASC", "DESC"):
            with contextlib.suppress(sqlite3.Error):
                known.update(db.execute(f"SELECT id, samples FROM {source} ORDER BY id {order}"))  # noqa: S608 - names of our own
    return {i: n for i, n in known.items() if type(i) is int and type(n) is int}
