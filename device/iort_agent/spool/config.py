"""The configuration's section `queue`."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from iort_agent.common.schema import Place, choice, number, setting
from iort_agent.spool.interface import FULL, OVERWRITE_OLDEST, PROCESS, REJECT_NEW

# The value of ``path`` for a queue that ends with the agent.
MEMORY = "memory"


def default_path(file: Path, robot: str) -> Path:
    """The queue's file if the configuration names none: beside it, or, if that folder may not be written, in
    the service's or the user's folder of state. Each robot has its own."""
    name, folder = f"{robot}.queue.db", file.absolute().parent
    if os.access(folder, os.W_OK):
        return folder / name
    # systemd makes the folder of `StateDirectory`, and may name several.
    service = os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    state = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return (Path(service) if service else Path(state).expanduser() / "iort") / name


def _queue_file(value: Any, where: Place) -> Path | None:
    """The path of a file that may be made: in a folder that exists, and not the configuration's own."""
    allowed = f"the path of a file, in a folder that exists, or {MEMORY}"
    if value is None or value == MEMORY:
        return None
    if not isinstance(value, str) or not value:
        raise where.error(value, allowed)
    path = where.file.parent / Path(value).expanduser()
    if not path.parent.is_dir():
        raise where.error(value, f"{allowed}, and there is no {path.parent}")
    if path.is_dir() or path.resolve() == where.file.resolve():
        raise where.error(value, f"{allowed}, that is nothing else already")
    return path


@dataclass(frozen=True)
class QueueConfig:
    """Where batches wait for the broker, and what to drop when it is full (Greengrass' words).

    ``path``: the queue's file, which need not exist. Without it, it is ``<robot>.queue.db`` beside the
    configuration. ``memory``: the queue ends with the agent, and so does what waits in it.
    ``max_bytes`` bounds the batches in it, and the file is a little larger. ``durability``: what the
    file survives, the end of the process or a power cut (``full``) too.
    """

    path: Path | None = setting(_queue_file, None)
    max_bytes: int = setting(number(200_000, 2**40, whole=True, unit="bytes"), 64 * 1024 * 1024)
    policy: str = setting(choice(OVERWRITE_OLDEST, REJECT_NEW), OVERWRITE_OLDEST)
    durability: str = setting(choice(PROCESS, FULL), PROCESS)
