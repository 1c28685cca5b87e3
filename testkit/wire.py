"""A bad network between two machines: delay, loss, a narrow line with a short queue, a cut.

`Wire` lays a cable from each machine to a third one, where a process of its own passes each frame on, or
not. What it does is decided by its seed and the frames' order. It needs no module of the kernel beside
those of namespaces: machines of CI have no netem.
"""

from __future__ import annotations

import heapq
import json
import os
import random
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from typing_extensions import Self

from testkit.namespaces import Machine, addressed, lay_cable, machines
from testkit.waiting import GUARD_S, InstrumentError

# packet(7): frames come with what the kernel has left to do of their checksums, and are sent with it.
_SOL_PACKET, _PACKET_VNET_HDR, _ETH_P_ALL = 263, 15, 3
_HEAD, _FRAME = 10, 65_536
# A frame's bytes on a line beside those that are seen here: preamble, checksum and gap.
_LINE_BYTES = 24
_BUFFER_BYTES = 8_000_000


@dataclass(frozen=True)
class Conditions:
    """Of each way: the delay, the share of frames that are lost, the line's rate (0 is without end) with
    the longest wait in its queue, and whether it is cut."""

    delay_ms: float = 0.0
    loss: float = 0.0
    kbit_s: float = 0.0
    queue_ms: float = 100.0
    cut: bool = False


class Way:
    """One direction: tells of each frame when it arrives, or that it is lost. It has no clock."""

    def __init__(self, seed: int) -> None:
        self.conditions = Conditions()
        self._random = random.Random(seed)  # noqa: S311 - a seed, so that a run can be repeated
        self._free = 0.0
        self.passed = self.lost = self.dropped = self.bytes = 0

    def due(self, now: float, size: int) -> float | None:
        """When a frame of so many bytes, which comes now, arrives; None if it does not. In seconds."""
        known = self.conditions
        # Drawn for every frame, so that a change of the loss alone leaves the others' lot.
        unlucky = self._random.random() < known.loss
        if known.cut or unlucky:
            self.lost += 1
            return None
        begin = max(now, self._free)
        if known.kbit_s:
            if begin - now > known.queue_ms / 1000:
                self.dropped += 1
                return None
            self._free = begin + (size + _LINE_BYTES) * 8 / (known.kbit_s * 1000)
            begin = self._free
        self.passed, self.bytes = self.passed + 1, self.bytes + size
        return begin + known.delay_ms / 1000


class Wire:
    """Two machines, `one` and `other`, from `__enter__` to `__exit__`, with the network between them.

    Raises `NoNamespacesError` where they cannot be made.
    """

    def __init__(self, folder: Path, *, seed: int = 1) -> None:
        self._folder, self._seed = folder, seed
        self._exit = ExitStack()
        self.conditions = Conditions()
        self.one: Machine
        self.other: Machine
        self._process: subprocess.Popen[str]

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            one, middle, other = stack.enter_context(machines(self._folder, "one", "middle", "other"))
            for machine, end in ((one, "left"), (other, "right")):
                lay_cable(machine, "cable", middle, end)
            self.one, self.other = addressed(one, "cable", 1), addressed(other, "cable", 2)
            command = middle.command(sys.executable, "-m", "testkit.wire", "left", "right", str(self._seed))
            self._process = subprocess.Popen(
                command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=dict(os.environ)
            )
            stack.callback(self._end)
            self.counts()
            self._exit = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exit.close()

    def set(self, **changes: object) -> None:
        """Change some of the conditions; returns once they are in force."""
        self.conditions = replace(self.conditions, **changes)  # type: ignore[arg-type]  # their names are checked by the class
        self._tell(self.conditions)

    def counts(self) -> dict[str, int]:
        """The frames passed, lost and dropped for want of room so far, and the bytes; both ways together."""
        return self._tell(None)

    def _tell(self, conditions: Conditions | None) -> dict[str, int]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):
            print(json.dumps(asdict(conditions) if conditions else {}), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            raise InstrumentError(f"the network between the machines ended: {self._process.wait(GUARD_S)}")
        counts: dict[str, int] = json.loads(answer)
        return counts

    def _end(self) -> None:
        self._process.communicate()  # the end of its input ends it


# --- the process in the middle ---------------------------------------------------------------------


def _opened(end: str) -> socket.socket:
    """The end of a cable: every frame of others that comes there."""
    opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
    for name in (socket.SO_RCVBUF, socket.SO_SNDBUF):
        opened.setsockopt(socket.SOL_SOCKET, name, _BUFFER_BYTES)
    opened.setsockopt(_SOL_PACKET, _PACKET_VNET_HDR, 1)
    opened.bind((end, _ETH_P_ALL))
    opened.setblocking(False)
    return opened


def _frames(opened: socket.socket) -> Iterator[bytes]:
    while True:
        try:
            frame, (_, _, kind, _, _) = opened.recvfrom(_FRAME + _HEAD)
        except BlockingIOError:
            return
        # What we send here comes back to us.
        if kind != socket.PACKET_OUTGOING:
            yield frame


def _run(ends: list[str], seed: int) -> None:
    ways = [(_opened(end), Way(seed + i)) for i, end in enumerate(ends)]
    waiting: list[tuple[float, int, int, bytes]] = []
    came = 0
    while True:
        left_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else None
        ready, _, _ = select.select([sys.stdin, *(opened for opened, _ in ways)], [], [], left_s)
        now = time.monotonic()
        for i, (opened, way) in enumerate(ways):
            if opened in ready:
                for frame in _frames(opened):
                    came += 1
                    if (due := way.due(now, len(frame) - _HEAD)) is not None:
                        heapq.heappush(waiting, (due, came, 1 - i, frame))
        while waiting and waiting[0][0] <= time.monotonic():
            _, _, to, frame = heapq.heappop(waiting)
            # A full buffer of the kernel, or a cable that is gone, loses it.
            with suppress(OSError):
                ways[to][0].send(frame)
        if sys.stdin in ready:
            line = sys.stdin.readline()
            if not line:
                return
            if changes := json.loads(line):
                for _, way in ways:
                    way.conditions = Conditions(**changes)
                if changes["cut"]:
                    waiting.clear()  # what was on its way is lost
            names = ("passed", "lost", "dropped", "bytes")
            counts = {name: sum(getattr(way, name) for _, way in ways) for name in names}
            sys.stdout.write(json.dumps(counts) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    with suppress(PermissionError):  # a frame that is late is worse than another process that waits
        os.nice(-10)
    _run(sys.argv[1:3], int(sys.argv[3]))
