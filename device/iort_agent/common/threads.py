"""Time as a seam for tests, and the long-lived threads of the process, which are all in `THREADS`.

Each runs under one supervised loop. When its target raises, the log gets an error, the status an alarm, and
the agent's metrics a count. Then, as `THREADS` says, the target starts again after a wait that doubles from
`FIRST_S`, or the process ends with status 1, and systemd starts a new one.

```
        ┌──────── start ◄───── wait ◄──┐
        ▼                              │ RESTART
     running ── raises ── alarm ───────┤
        │                              │ END
        ▼ returns                      ▼
      ended                     the process ends
```

Alarms belong to the process, as its threads do. The alarm of a thread ends with the thread, or `SHOWN_S`
after its last error."""

from __future__ import annotations

import logging
import os
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Callable, NamedTuple, Protocol

_log = logging.getLogger(__name__)

RESTART, END = "restart", "end"
FIRST_S, SHOWN_S = 0.1, 600.0
# A thread that ran for longer has recovered: its next wait is short again.
_RECOVERED_S = 60.0
# The same error is logged again after this time.
_LOG_AGAIN_S = 60.0


class Clock(Protocol):
    """Wall time, monotonic time and waiting; a test needs all three from one clock."""

    def now_us(self) -> int:
        """Wall time in microseconds since the Unix epoch; may jump."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never jumps."""

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        """Wait until the event is set or the seconds have passed; whether it is set."""


class SystemClock:
    """The machine's own clock."""

    def now_us(self) -> int:
        return time.time_ns() // 1000

    monotonic = staticmethod(time.monotonic)

    def wait(self, event: threading.Event, seconds: float | None) -> bool:
        return event.wait(seconds)


class Pace:
    """Deadlines counted from one start, so that small delays do not add up."""

    def __init__(self, clock: Clock, stop: threading.Event) -> None:
        self._clock = clock
        self._stop = stop
        self._start = clock.monotonic()

    def until(self, offset_s: float) -> bool:
        """Wait until ``offset_s`` after the start. False if ``stop`` is set. A late call returns at once."""
        remaining = self._start + offset_s - self._clock.monotonic()
        if remaining <= 0:
            return not self._stop.is_set()
        return not self._clock.wait(self._stop, remaining)


class Kind(NamedTuple):
    """What follows an error of a thread, and the longest wait before it starts again."""

    then: str = RESTART
    longest_s: float = 10.0


THREADS = {
    "asks": Kind(),
    "callbacks": Kind(longest_s=1.0),
    "camera": Kind(longest_s=2.0),
    # It publishes the stops.
    "downlink": Kind(longest_s=FIRST_S),
    "guard": Kind(longest_s=1.0),
    "incidents": Kind(),
    "pings": Kind(),
    "record": Kind(longest_s=1.0),
    "recorder": Kind(longest_s=1.0),
    "ring": Kind(longest_s=1.0),
    # rospy cannot be begun anew in the middle of anything.
    "ros1 node": Kind(END),
    "ros2 node": Kind(END),
    "source": Kind(),
    "spool": Kind(longest_s=1.0),
    "status": Kind(),
    "ticker": Kind(longest_s=1.0),
    "uplink": Kind(longest_s=1.0),
    "uploads": Kind(),
    "video": Kind(longest_s=1.0),
}


class Watch:
    """What went wrong in the threads of a process."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Thread -> the monotonic time of its last error, and what to say.
        self._alarms: dict[Supervised, tuple[float, str]] = {}
        self._end: Callable[[], None] = _exit
        # The errors of all threads since the start.
        self.errors = 0

    def on_end(self, handler: Callable[[], None]) -> None:
        """Call the handler, in the failed thread, when the process must end; else it ends at once."""
        self._end = handler

    def alarms(self) -> list[str]:
        """Which threads failed lately, and why."""
        now = time.monotonic()
        with self._lock:
            return [text for at, text in self._alarms.values() if now - at < SHOWN_S]

    def note(self, thread: Supervised, text: str) -> None:
        """Note an error."""
        with self._lock:
            self.errors += 1
            self._alarms[thread] = time.monotonic(), text

    def forget(self, thread: Supervised) -> None:
        """Forget a thread that has ended."""
        with self._lock:
            self._alarms.pop(thread, None)

    def end(self) -> None:
        """End the process."""
        self._end()


def _exit() -> None:
    os._exit(1)


WATCH = Watch()


class Supervised:
    """A thread that runs ``target`` until it returns. ``kind`` is its name in `THREADS`; ``title`` tells it
    from others of its kind."""

    def __init__(
        self,
        kind: str,
        target: Callable[[], object],
        *,
        title: str = "",
        clock: Clock | None = None,
        watch: Watch = WATCH,
    ) -> None:
        self.name = f"{kind} {title}".rstrip()
        self._kind, self._target, self._watch = THREADS[kind], target, watch
        self._clock = clock or SystemClock()
        self._ending = threading.Event()
        self._errors, self._logged = 0, ("", 0.0)
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def is_alive(self) -> bool:
        """Whether it has begun and has not ended; also while it waits to start again."""
        return self._thread.is_alive()

    def join(self, timeout_s: float | None = None) -> None:
        """Wait for its end, after the target was told to end: from now on it does not start again."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        wait_s = FIRST_S
        with suppress(OSError):  # not Linux
            # `top -H` shows it; Python tells the kernel no names.
            Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_text(self.name, encoding="utf-8")
        try:
            while True:
                began = self._clock.monotonic()
                try:
                    self._target()
                except BaseException as error:  # noqa: BLE001 - a library may raise anything, also SystemExit
                    self._note(error)
                else:
                    return
                if self._kind.then == END:
                    self._watch.end()
                    # The alarm stays until the process has ended.
                    self._ending.wait()
                    return
                if self._clock.monotonic() - began > _RECOVERED_S:
                    wait_s = FIRST_S
                if self._clock.wait(self._ending, wait_s):
                    return
                wait_s = min(wait_s * 2, self._kind.longest_s)
        finally:
            self._watch.forget(self)

    def _note(self, error: BaseException) -> None:
        self._errors += 1
        why = f"{type(error).__name__}: {error}"
        then = "starts again" if self._kind.then == RESTART else "cannot start again, so the agent ends"
        at = time.strftime("%H:%M:%SZ", time.gmtime(self._clock.now_us() / 1e6))
        text = f"the thread {self.name} failed and {then}: {self._errors} time(s), the last at {at}: {why}"
        self._watch.note(self, text)
        logged, logged_at = self._logged
        if why != logged or self._clock.monotonic() - logged_at > _LOG_AGAIN_S:
            self._logged = why, self._clock.monotonic()
            _log.error("the thread %s failed and %s", self.name, then, exc_info=error)


def brief(name: str, target: Callable[[], object]) -> None:
    """Run a call that ends by itself and that somebody waits for, within a limit. It handles its errors."""
    threading.Thread(target=target, name=name, daemon=True).start()


def later(delay_s: float, call: Callable[[], object]) -> threading.Timer:
    """Run a call after the delay, unless the timer is cancelled. It raises nothing and waits for nothing."""
    timer = threading.Timer(delay_s, call)
    timer.daemon = True
    timer.start()
    return timer
