"""Runs a source in its own thread and collects its samples."""

from __future__ import annotations

import threading
from typing import Any

from typing_extensions import Self

from iort_agent.common.threads import SystemClock
from iort_contract.catalog.streams import TYPES_STREAM
from testkit.waiting import GUARD_S


class Running:
    """Runs a source within a `with`."""

    def __init__(self, config: Any) -> None:
        self.source = config.build(SystemClock())
        self.samples: list[tuple[str, int, Any]] = []
        self.said: list[Any] = []
        self.stop = threading.Event()
        self.failed: Exception | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self._more = threading.Condition()

    def __enter__(self) -> Self:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        self.thread.join(GUARD_S)
        assert not self.thread.is_alive()
        assert self.failed is None

    def wait_for(self, count: int, *, more: bool = False) -> None:
        """Wait for a number of samples, in total or from now on."""
        with self._more:
            wanted = count + (len(self.samples) if more else 0)
            assert self._more.wait_for(lambda: len(self.samples) >= wanted, GUARD_S), len(self.samples)

    def _run(self) -> None:
        try:
            self.source.run(self._emit, self.stop)
        except Exception as error:  # noqa: BLE001 - the test reads the error
            self.failed = error

    def _emit(self, stream: str, t_us: int, values: Any, **_: bool) -> float:
        with self._more:
            if stream == TYPES_STREAM:
                self.said.append(values)
            else:
                self.samples.append((stream, t_us, values))
                self._more.notify_all()
        return 0.0
