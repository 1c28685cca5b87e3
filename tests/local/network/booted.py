"""systemd as the first process of namespaces of its own: a machine that has booted, and reaches nobody."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from local.deployment import ROOT
from local.processes import Child
from testkit.waiting import until

_TOOL = "systemd-nspawn"
# Its own unit is ours, or none: we ask no systemd of this machine.
# None of the services that this machine has, but those that every boot needs.
# There is no network to wait for, which would take two minutes.
_MASKED = ("systemd-firstboot.service", "systemd-networkd-wait-online.service")
_BARE = ("systemd.unit=basic.target", *(f"systemd.mask={service}" for service in _MASKED))
_ALONE = ("--register=no", "--keep-unit", "--link-journal=no", "--private-network", "--console=pipe")


class Booted:
    """The machine. Of the real one it has /usr, Python and this checkout, and what is bound into it."""

    def __init__(self, first: int) -> None:
        self._first = first

    def run(self, *command: str, **environment: str) -> str:
        """Run a command to its end as root, and return its output."""
        done = self._run(*command, **environment)
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout

    def is_up(self) -> bool:
        """Whether it has booted."""
        return self._run("systemctl", "is-system-running").stdout.strip() in {"running", "degraded"}

    def _run(self, *command: str, **environment: str) -> subprocess.CompletedProcess[str]:
        inside = ("nsenter", f"--target={self._first}", "--mount", "--uts", "--ipc", "--net", "--pid")
        return subprocess.run(
            [*inside, "env", f"--chdir={ROOT}", *command],
            env={"PATH": os.defpath, "HOME": "/root", **environment},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )


@contextmanager
def booted(folder: Path) -> Iterator[Booted]:
    """Boot one, with a folder in it. Skips where that is not possible."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root may boot systemd in namespaces")
    if shutil.which(_TOOL) is None:
        pytest.skip(f"{_TOOL} is not installed: apt-get install systemd-container")
    name = f"iort{os.getpid()}"
    # Without the two files "localhost" has no address there.
    read = (Path(sys.base_prefix).resolve(), "/etc/hosts", "/etc/nsswitch.conf")
    bound = [f"--bind={ROOT}", f"--bind={folder}", *(f"--bind-ro={path}" for path in read)]
    child = Child(
        "systemd",
        [_TOOL, "--directory=/", "--volatile=yes", "--boot", f"--machine={name}", *_ALONE, *bound, *_BARE],
        environment=os.environ,
        cwd=folder,
        log=folder / "boot.log",
        orphaned=signal.SIGTERM,
    )
    try:
        first = until(lambda: child.poll() is not None or _first(child.pid))
        if child.poll() is not None:
            pytest.skip(f"this machine boots no systemd in namespaces:\n{child.tail()}")
        machine = Booted(first)
        until(machine.is_up)
        yield machine
    finally:
        child.stop()
        # It leaves this one, and says so.
        shutil.rmtree(f"/run/systemd/nspawn/propagate/{name}", ignore_errors=True)


def _first(tool: int) -> int | None:
    """The first process of the new namespaces; the tool has another child before it."""
    for child in Path(f"/proc/{tool}/task/{tool}/children").read_text().split():
        with suppress(FileNotFoundError):
            status = Path(f"/proc/{child}/status").read_text().splitlines()
            numbers = next(line for line in status if line.startswith("NSpid:")).split()
            if len(numbers) > 2 and numbers[-1] == "1":
                return int(child)
    return None
