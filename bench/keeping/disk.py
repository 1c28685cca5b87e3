"""A small disk for a cloud's folder, which the bench fills and frees: a file system in memory.

It is mounted in a mount namespace of the bench's own, which needs neither root nor leaves anything behind.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from typing_extensions import Self

from bench.errors import BenchError

_INSIDE = "BENCH_OWN_MOUNTS"
_UNSHARE = ("unshare", "--user", "--map-root-user", "--mount")
# It takes memory for what is in it only.
_BYTES = 4 * 2**30
_TRIES = 100


def possible() -> bool:
    """Whether this process may mount: see `enter`."""
    return _INSIDE in os.environ


def enter(module: str) -> None:
    """Run this command again, as the module that it is, where it may mount; returns if that is done, or where
    the machine does not allow it."""
    if possible() or shutil.which(_UNSHARE[0]) is None:
        return
    if subprocess.run([*_UNSHARE, "true"], capture_output=True, check=False).returncode == 0:
        os.environ[_INSIDE] = "1"
        command = [*_UNSHARE, sys.executable, "-m", module, *sys.argv[1:]]
        os.execvp(command[0], command)  # noqa: S606 - it needs no shell


class Disk:
    """The disk at an empty folder, from `__enter__` to `__exit__`.

    ``within`` is what a command begins with to run where the disk is mounted, if that is not here.
    """

    def __init__(self, folder: Path, *, within: Sequence[str] = ()) -> None:
        self.folder, self._within = folder, within

    def __enter__(self) -> Self:
        self.folder.mkdir(parents=True)
        self._run("mount", "-t", "tmpfs", "-o", f"size={_BYTES},mode=700", "tmpfs")
        return self

    def __exit__(self, *_: object) -> None:
        self._run("umount", "--lazy")

    @contextmanager
    def full(self) -> Iterator[None]:
        """No byte is free."""
        self._fill()
        try:
            yield
        finally:
            self._resize(_BYTES)

    def _fill(self) -> None:
        for last in (*[False] * _TRIES, True):
            blocks, free, size = self._run("stat", "--file-system", "--format=%b %f %S").split()
            try:
                self._resize((int(blocks) - int(free)) * int(size))
            except BenchError:
                # It cannot be smaller than what is in it, and somebody may have written meanwhile.
                if last:
                    raise
            else:
                return

    def _resize(self, size: int) -> None:
        self._run("mount", "-o", f"remount,size={size}")

    def _run(self, *command: str) -> str:
        """Run a command about the folder, and return its output."""
        whole = [*self._within, *command, str(self.folder)]
        done = subprocess.run(whole, capture_output=True, text=True, check=False)
        if done.returncode:
            raise BenchError(f"`{' '.join(whole)}` failed: {done.stderr.strip()}")
        return done.stdout
