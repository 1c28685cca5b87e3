"""Stands in for a VESC: a thread that answers requests over a pseudo-terminal.

The client opens a symbolic link, as in /dev/serial/by-id; `unplug` removes the terminal and the link,
`plug` restores both with another terminal.
"""

from __future__ import annotations

import binascii
import os
import queue
import select
import struct
import threading
import tty
from pathlib import Path
from typing import Callable, List

from typing_extensions import Self

from testkit.waiting import GUARD_S

FIRMWARE = b"\x00\x06\x02" + b"60_MK6\x00" + bytes(12) + b"\x00\x00\x00"


def framed(payload: bytes) -> bytes:
    """Make a frame by the description alone, without the code under test."""
    n = len(payload)
    head = struct.pack(">BB", 2, n) if n < 256 else struct.pack(">BH", 3, n)
    crc = 0
    for byte in payload:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    assert crc == binascii.crc_hqx(payload, 0)
    return head + payload + struct.pack(">HB", crc, 3)


def values(n: int = 0, *, length: int = 74, controller: int = 1) -> bytes:
    """Make an answer of current firmware, with number ``n`` in its tachometer; shorter for older firmware."""
    payload = struct.pack(
        ">BhhiiiihihiiiiiiBiBhhhiiB",
        4, 251, 333, 1234, 567, -12, 1230, 305, 8123, 118, 281, 1, 12908, 48, n, n + 1, 0,
        307_511_000, controller, 241, 242, 243, -233, 24842, 1,
    )  # fmt: skip
    return payload[:length]


Answer = Callable[[bytes, int], List[bytes]]


class VescStandin:
    """Answers COMM_GET_VALUES; ``answer`` may be changed at any time.

    ``answer`` gets the correct frame and its number, and returns the frames to send instead.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self.asked: list[bytes] = []
        self.sent = 0
        self.length = 74
        self.answer: Answer = lambda frame, n: [frame]
        self._commands: queue.Queue[tuple[Callable[[], None], threading.Event]] = queue.Queue()
        self._wake_out, self._wake_in = os.pipe()
        self._master = self._slave = -1
        self._done = False
        self._thread = threading.Thread(target=self._run, name="vesc", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self.plug()
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()
        self._do(lambda: setattr(self, "_done", True))
        self._thread.join(GUARD_S)
        os.close(self._wake_in)
        os.close(self._wake_out)

    def plug(self) -> None:
        """Create a terminal and its link."""
        self._do(self._plug)

    def unplug(self) -> None:
        """Remove both, at any moment."""
        self._do(self._unplug)

    def say(self, data: bytes) -> None:
        """Send an unrequested frame."""
        self._do(lambda: self._write(data))

    def _do(self, command: Callable[[], None]) -> None:
        done = threading.Event()
        self._commands.put((command, done))
        os.write(self._wake_in, b"x")
        assert done.wait(GUARD_S)

    def _plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.link.symlink_to(os.ttyname(self._slave))

    def _unplug(self) -> None:
        if self._master >= 0:
            self.link.unlink()
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def _write(self, data: bytes) -> None:
        os.write(self._master, data)

    def _run(self) -> None:
        received = b""
        while not self._done:
            ready, _, _ = select.select(
                [self._wake_out] + ([self._master] if self._master >= 0 else []), [], []
            )
            if self._wake_out in ready:
                os.read(self._wake_out, 1)
                command, done = self._commands.get()
                command()
                done.set()
                received = b""
            elif self._master in ready:
                received = self._serve(received + os.read(self._master, 4096))

    def _serve(self, received: bytes) -> bytes:
        """Answer the complete requests; return the remaining bytes."""
        while len(received) >= 2 and len(received) >= received[1] + 5:
            one, received = received[: received[1] + 5], received[received[1] + 5 :]
            payload = one[2:-3]
            assert one == framed(payload), one
            self.asked.append(payload)
            controller = payload[1] if payload[0] == 34 else 1
            intact = framed(values(self.sent, length=self.length, controller=controller))
            answers = self.answer(intact, self.sent)
            self.sent += 1
            for chunk in answers:
                self._write(chunk)
        return received
