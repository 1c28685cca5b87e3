"""`iort bridge` in a process, and a client of it that we did not write, in another one: see client.py."""

from __future__ import annotations

import base64
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from typing_extensions import Self

from testkit.waiting import GUARD_S, until

PLAYING, PAUSED, BUFFERING, ENDED = range(4)


@contextmanager
def bridging(
    command: Sequence[str], environment: Mapping[str, str] | None = None
) -> Iterator[dict[str, Any]]:
    """Run a command that is `iort bridge --json`, and give what it says of itself; it ends by Ctrl-C."""
    with subprocess.Popen(
        command,
        env={**os.environ, **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stderr is not None
            line = process.stdout.readline()
            assert line, process.stderr.read()
            yield json.loads(line)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                _, errors = process.communicate(timeout=GUARD_S)
            except subprocess.TimeoutExpired:
                process.kill()  # or this would wait for it for ever
                raise
    assert process.returncode == 130, errors
    assert "Traceback" not in errors


class Got(NamedTuple):
    """A message that the client has got."""

    topic: str
    t_ns: int
    data: bytes

    @property
    def fields(self) -> dict[str, Any]:
        fields: dict[str, Any] = json.loads(self.data)
        return fields


class Judge:
    """Connects within a ``with`` block, once it knows the server's topics.

    ``within`` is what a command begins with to run on another machine, and ``authority`` who signs the
    servers' certificates that it trusts, if it is not the system.
    """

    def __init__(self, url: str, *, within: Sequence[str] = (), authority: Path | None = None) -> None:
        self._url, self._within = url, within
        self._trusts = {} if authority is None else {"SSL_CERT_FILE": str(authority)}
        self.events: list[dict[str, Any]] = []

    def __enter__(self) -> Self:
        script = Path(__file__).with_name("client.py")
        self._process = subprocess.Popen(
            [*self._within, sys.executable, "-W", "error::SyntaxWarning", str(script), self._url],
            env={**os.environ, **self._trusts},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        until(lambda: self.of("server") and self.topics)
        return self

    def __exit__(self, *_error: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(GUARD_S)
        self._reader.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.events.extend(map(json.loads, self._process.stdout))

    def of(self, event: str) -> list[dict[str, Any]]:
        """The events of a kind."""
        return [one for one in list(self.events) if one["event"] == event]

    @property
    def topics(self) -> dict[str, dict[str, Any]]:
        """The channels by their topics."""
        return {one["channel"]["topic"]: one["channel"] for one in self.of("channel")}

    def do(self, what: str, **how: Any) -> None:
        """Have it do something."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": what, **how}) + "\n")
        self._process.stdin.flush()

    def play(self, name: str, *, seek_ns: int | None = None, speed: float = 1.0, play: bool = True) -> int:
        """Control playback, and wait for the answer to this request; returns how many events came before."""
        self.do("playback", play=play, speed=speed, seek_ns=seek_ns, id=name)
        until(lambda: any(one["id"] == name for one in self.of("state")))
        return next(i for i, one in enumerate(self.events) if one.get("id") == name)

    def ended(self, after: int) -> None:
        """Wait for the end of what is played after an event."""
        until(
            lambda: any(
                one["event"] == "state" and one["status"] == ENDED for one in list(self.events)[after:]
            )
        )

    def got(self, topic: str | None = None, after: int = 0) -> Iterator[Got]:
        """The messages of a topic, or of all, after an event."""
        for one in list(self.events)[after:]:
            if one["event"] == "message" and topic in {None, one["topic"]}:
                yield Got(one["topic"], one["t_ns"], base64.b64decode(one["data"]))
