"""Connections are numbered upwards over restarts of the broker: a lower number is an old event's."""

from __future__ import annotations

import time
from typing import Any

from ministack.services import iot


class _Numbers(dict[Any, int]):
    """The next number of each client; the first one is the second of the start."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._first = first

    def get(self, key: Any, _default: Any = None) -> int:
        return super().get(key, self._first)


def install() -> None:
    """Do so in this process. No client connects once a second from then on."""
    iot._presence_versions = _Numbers(int(time.time()))
