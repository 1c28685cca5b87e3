"""The pinned ministack with our patches, and other folders of build/ made once from sources."""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from local.processes import LocalError

_KEPT = 4


def artifact(folder: Path, key: str, sources: Iterable[Path], make: Callable[[Path], object]) -> Path:
    """Return the folder below ``folder`` for the key and the sources' content; ``make`` fills a new one.

    Processes may call it at the same time: one makes it, the others wait. The oldest folders are removed.
    Raises `LocalError` in a checkout that is another user's, if it has no such folder.
    """
    digest = hashlib.sha256(f"{sys.version} {key}".encode())
    for source in sources:
        digest.update(f"{source}\0".encode() + source.read_bytes())
    found = folder / digest.hexdigest()[:16]
    if found.is_dir():
        # A read-only checkout keeps what it has.
        with suppress(OSError):
            found.touch()
        return found
    there = next(one for one in (folder, *folder.parents) if one.exists())
    if not os.access(there, os.W_OK):
        raise LocalError(
            f"you must be able to write {there}: its owner must run this once, or use a checkout of your own"
        )
    folder.mkdir(parents=True, exist_ok=True)
    making = found.with_suffix(".new")
    with (folder / "making.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not found.is_dir():
            # A process that was killed may have left a part of it.
            shutil.rmtree(making, ignore_errors=True)
            make(making)
            making.rename(found)
            made = [one for one in folder.iterdir() if not one.suffix]
            for old in sorted(made, key=lambda one: one.stat().st_mtime)[:-_KEPT]:
                shutil.rmtree(old, ignore_errors=True)
    return found


# The pinned ministack with the patches of local/patches/: a copy in build/, made with `git apply`.

_ROOT = Path(__file__).resolve().parents[2]
PATCHES = tuple(sorted((_ROOT / "local" / "patches").glob("*.patch")))


def folder() -> Path:
    """Return the folder that contains the patched package. Raises `LocalError` if a patch does not apply."""
    package = installed()
    key = next(path.name for path in package.parent.glob("ministack-*.dist-info"))
    return artifact(_ROOT / "build" / "ministack", key, PATCHES, lambda made: copy(package, made, PATCHES))


def use() -> None:
    """Let this process import the patched ministack; call it before the first import."""
    sys.path.insert(0, str(folder()))


def installed() -> Path:
    """Return the folder of the package as pip installed it."""
    for entry in sys.path:
        package = Path(entry) / "ministack"
        if package.is_dir() and not package.is_relative_to(_ROOT / "build"):
            return package
    raise LocalError("ministack is not installed: run `make setup`")


def copy(package: Path, made: Path, patches: Sequence[Path]) -> None:
    """Copy the package into the folder ``made``, and apply the patches."""
    shutil.copytree(package, made / "ministack", ignore=shutil.ignore_patterns("__pycache__"))
    git = shutil.which("git")
    if git is None:
        raise LocalError("git is not installed; it applies local/patches/ to ministack")
    done = subprocess.run(  # noqa: S603 - our own patches
        [git, "apply", *map(str, patches)],
        cwd=made,
        # No repository above the folder may take part.
        env={**os.environ, "GIT_CEILING_DIRECTORIES": str(made.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise LocalError(f"a patch of local/patches/ does not fit the installed ministack:\n{done.stderr}")
