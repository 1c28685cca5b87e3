"""The pinned ministack with the patches of local/patches/: a copy in build/, made with `git apply`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from local.errors import LocalError
from local.made_once import kept

_ROOT = Path(__file__).resolve().parents[2]
PATCHES = tuple(sorted((_ROOT / "local" / "patches").glob("*.patch")))


def folder() -> Path:
    """Return the folder that contains the patched package. Raises `LocalError` if a patch does not apply."""
    package = installed()
    key = next(path.name for path in package.parent.glob("ministack-*.dist-info"))
    return kept(_ROOT / "build" / "ministack", key, PATCHES, lambda made: copy(package, made, PATCHES))


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
