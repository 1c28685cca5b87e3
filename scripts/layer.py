"""Builds Lambda 1's layer into build/layer/<for>: the packages of requirements/layer.txt, and their bytecode.

    python -m scripts.layer {local,lambda} [--compiler PYTHON]

What is installed follows from the Python and the platform that the layer is for, whatever this runs on.
Bytecode is read by one version of Python alone, so it needs a compiler of that version: without one, the
layer has none, and Lambda compiles at every cold start.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from stacks.target import PLATFORM, PYTHON

ROOT = Path(__file__).resolve().parent.parent
# No compiler of C is needed: pubnub, which publishes no wheel, is Python alone.
# It is built with the locked setuptools of .venv, not with whatever is newest today.
LOCKED = (
    *("--require-hashes", "--no-deps", "--only-binary", ":all:"),
    *("--no-binary", "pubnub", "--no-build-isolation"),
)


@dataclass(frozen=True)
class Target:
    """The Python and, as uv names it, the platform that a layer is for."""

    python: str
    platform: str | None = None


LOCAL = Target(f"{sys.version_info[0]}.{sys.version_info[1]}")
LAMBDA = Target(PYTHON, PLATFORM)


def main() -> None:
    """Build one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=["local", "lambda"], help="for this machine, or for AWS")
    parser.add_argument("--compiler", metavar="PYTHON", help=f"a Python {PYTHON}, for lambda")
    asked = parser.parse_args()
    local = asked.name == "local"
    compiler = sys.executable if local else asked.compiler
    build(
        ROOT / "build" / "layer" / asked.name,
        ROOT / "requirements" / "layer.txt",
        LOCAL if local else LAMBDA,
        compiler,
    )


def build(folder: Path, requirements: Path, target: Target, compiler: str | None) -> None:
    """Build the layer anew. Raises `subprocess.CalledProcessError`."""
    shutil.rmtree(folder, ignore_errors=True)
    packages = folder / "python"
    platform = ["--python-platform", target.platform] if target.platform else []
    subprocess.run(
        [
            *(Path(sys.executable).with_name("uv"), "pip", "install", "--quiet", *LOCKED),
            *("--python", sys.executable, "--python-version", target.python, *platform),
            *("--target", packages, "--link-mode", "copy", "--requirements", requirements),
        ],
        check=True,
    )
    # Programs begin with the path of this machine's Python, and nothing calls them there.
    shutil.rmtree(packages / "bin", ignore_errors=True)
    (packages / ".lock").unlink(missing_ok=True)
    if compiler is not None:
        compile_all(packages, compiler)


def compile_all(folder: Path, compiler: str) -> None:
    """Compile every module below the folder. Two runs give the same bytes.

    "unchecked-hash": Python takes the bytecode as it is. A time stamp would not survive the archive that a
    layer is sent in. A module that this Python cannot compile is left to fail where it is imported.
    """
    subprocess.run(
        [
            *(compiler, "-m", "compileall", "-qq", "--invalidation-mode", "unchecked-hash"),
            # So a traceback names the module as Lambda finds it, and this machine's folders are not told.
            *("-s", folder, "-p", "/opt/python", folder),
        ],
        env={**os.environ, "PYTHONHASHSEED": "0"},
        check=False,
    )


if __name__ == "__main__":
    main()
