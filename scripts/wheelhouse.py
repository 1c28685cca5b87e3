"""Packs the agent with everything that it needs, for robots without a network: `make wheelhouse`.

An archive is for one architecture and for every Python that the agent runs on. It has wheels alone, at the
versions and with the hashes of requirements/robot.txt, and device/install.sh.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename

from scripts.release import ROOT, ReleaseError, pack, version

ARCHITECTURES = ("aarch64", "x86_64")
PYTHONS = ("3.8", "3.9", "3.10", "3.11", "3.12", "3.13")
LOCK = ROOT / "requirements" / "robot.txt"
# The C library of Ubuntu 20.04, the oldest system with Python 3.8.
_GLIBC = 31
# Some packages refuse the first patches of a Python. Ubuntu 20.04 has 3.8.10.
_PATCH = 10


def make(architecture: str, built: Iterable[Path], out: Path) -> Path:
    """Download the wheels for an architecture, and pack them with our own; the archive's path."""
    check_architecture(architecture)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / f"iort-wheelhouse-{version()}-{architecture}"
        folder.mkdir()
        with ThreadPoolExecutor(3) as pool:
            list(pool.map(partial(_download, architecture, folder), PYTHONS))
        ours = [
            path
            for path in built
            if path.name.startswith(("iort_contract", "iort_agent")) and path.suffix == ".whl"
        ]
        lines = [LOCK.read_text()]
        for wheel in ours:
            shutil.copy(wheel, folder)
            name, number, *_ = parse_wheel_filename(wheel.name)
            lines.append(f"{name}=={number} --hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}\n")
        (folder / "requirements.txt").write_text("".join(lines))
        script = (ROOT / "device" / "install.sh").read_text().replace("ARCHITECTURE", architecture)
        (folder / "install.sh").write_text(script)
        return pack(folder, out / f"{folder.name}.tar")


def check_architecture(architecture: str) -> None:
    """Raise ReleaseError for an architecture that has no packages."""
    if architecture not in ARCHITECTURES:
        raise ReleaseError(
            f"the architecture must be one of {', '.join(ARCHITECTURES)}, got {architecture!r}"
        )


def needed(architecture: str, python: str) -> Iterator[tuple[str, list[str]]]:
    """The lock's lines for a target: (name==version, hashes)."""
    environment = {
        "implementation_name": "cpython",
        "platform_machine": architecture,
        "platform_python_implementation": "CPython",
        "python_full_version": f"{python}.{_PATCH}",
        "python_version": python,
        "sys_platform": "linux",
    }
    for line in LOCK.read_text().replace("\\\n", "").splitlines():
        if line and line[0] not in " #":
            text, *hashes = line.split("--hash=")
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate(environment):
                yield (
                    f"{canonicalize_name(requirement.name)}{requirement.specifier}",
                    [one.strip() for one in hashes],
                )


def _download(architecture: str, folder: Path, python: str) -> None:
    # pip would evaluate the lock's markers for the Python that it runs on.
    lines = [" --hash=".join([pinned, *hashes]) for pinned, hashes in needed(architecture, python)]
    command = [sys.executable, "-m", "pip", "download", "-qq", "--no-deps", "--require-hashes"]
    command += ["--only-binary", ":all:", "--dest", str(folder), "--requirement", "/dev/stdin"]
    command += ["--implementation", "cp", "--python-version", f"{python}.{_PATCH}"]
    for abi in (f"cp{python.replace('.', '')}", "abi3", "none"):
        command += ["--abi", abi]
    for tag in (*(f"manylinux_2_{minor}" for minor in range(_GLIBC, 16, -1)), "manylinux2014"):
        command += ["--platform", f"{tag}_{architecture}"]
    done = subprocess.run(
        command,
        input="\n".join(lines),
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PIP_NO_INPUT": "1"},
    )
    if done.returncode:
        raise ReleaseError(
            f"each package must have a wheel for Python {python} on {architecture}, got:\n{done.stderr}"
        )
