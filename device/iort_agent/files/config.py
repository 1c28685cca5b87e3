"""The configuration's section `files`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from iort_agent.common.schema import Place, any_path, number, setting


def _folder(value: Any, place: Place) -> Path:
    path: Path = any_path()(value, place)
    if not path.is_dir():
        raise place.error(value, "the path of a folder that exists", f"; there is none at {path}")
    return path


@dataclass(frozen=True)
class FilesConfig:
    """Files to upload. A file in ``folder`` is finished when it has not changed for ``settle_s``. It is
    removed ``remove_after_s`` after its upload; without this setting it stays. ``rate_kb_s`` limits all
    uploads in kilobytes (1000) a second; 0 is no limit.

    Topics with ``large: upload`` put their contents into ``large_folder``: at most one every
    ``large_every_s``
    from each stream, and no more than ``large_max_mb`` (1e6 bytes) in all.
    """

    folder: Path | None = setting(_folder, None)
    settle_s: float = setting(number(1, 86_400, unit="s"), 10.0)
    remove_after_s: float | None = setting(number(0, 365 * 86_400, unit="s"), None)
    rate_kb_s: float = setting(number(0, 1e6, unit="kB/s"), 1000.0)
    large_folder: Path | None = setting(any_path(), None)
    large_every_s: float = setting(number(0, 86_400, unit="s"), 1.0)
    large_max_mb: float = setting(number(1, 1e6, unit="MB"), 1000.0)
