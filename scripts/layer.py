"""Builds Lambda 1's layer into build/layer/<for>: the packages of requirements/layer.txt, and their bytecode.

    python -m scripts.layer {local,lambda}

The packages depend only on the target's Python and platform, not on this machine. Bytecode fits only one
version of Python, so that version is needed here; without it Lambda compiles at every cold start.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from stacks.parts.target import PLATFORM, PYTHON

ROOT = Path(__file__).resolve().parent.parent
UV = Path(sys.executable).with_name("uv")
# No C compiler is needed: pubnub, which publishes no wheel, is pure Python.
# The build uses the locked setuptools of .venv, not today's newest.
LOCKED = (
    *("--require-hashes", "--no-deps", "--only-binary", ":all:"),
    *("--no-binary", "pubnub", "--no-build-isolation"),
)


@dataclass(frozen=True)
class Target:
    """The Python of a layer, and its platform in uv's spelling."""

    python: str
    platform: str | None = None


LOCAL = Target(f"{sys.version_info[0]}.{sys.version_info[1]}")
LAMBDA = Target(PYTHON, PLATFORM)


def main() -> None:
    """Build one layer."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=["local", "lambda"], help="for this machine, or for AWS")
    name = parser.parse_args().name
    target, compiler = (LOCAL, sys.executable) if name == "local" else (LAMBDA, interpreter(PYTHON))
    if compiler is None:
        print(f"setup: no bytecode: Python {PYTHON} is missing here, and uv could not fetch it.")
        print(
            "setup: Cold starts take longer. Install it, remove build/setup/layer-lambda, and run this again."
        )
    build(ROOT / "build" / "layer" / name, ROOT / "requirements" / "layer.txt", target, compiler)


def interpreter(version: str) -> str | None:
    """A Python of a version: this machine's, or one that uv fetches. None if there is neither."""
    code = "import sys; print(sys.executable)"
    command = [str(UV), "run", "--quiet", "--no-project", "--python", version, "python", "-c", code]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def build(folder: Path, requirements: Path, target: Target, compiler: str | None) -> None:
    """Build the layer from scratch; raises `subprocess.CalledProcessError`."""
    shutil.rmtree(folder, ignore_errors=True)
    packages = folder / "python"
    platform = ["--python-platform", target.platform] if target.platform else []
    subprocess.run(
        [
            *(UV, "pip", "install", "--quiet", *LOCKED),
            *("--python", sys.executable, "--python-version", target.python, *platform),
            *("--target", packages, "--link-mode", "copy", "--requirements", requirements),
        ],
        check=True,
    )
    # Scripts start with this machine's Python path, and Lambda never calls them.
    shutil.rmtree(packages / "bin", ignore_errors=True)
    (packages / ".lock").unlink(missing_ok=True)
    if compiler is not None:
        compile_all(packages, compiler)


def compile_all(folder: Path, compiler: str) -> None:
    """Compile every module below the folder. Two runs give the same bytes.

    "unchecked-hash": Python never compares the bytecode with the source. Time stamps would change in the
    layer's archive. A module that this Python cannot compile is left as source.
    """
    subprocess.run(
        [
            *(compiler, "-m", "compileall", "-qq", "--invalidation-mode", "unchecked-hash"),
            # Tracebacks then show Lambda's path, not this machine's folders.
            *("-s", folder, "-p", "/opt/python", folder),
        ],
        env={**os.environ, "PYTHONHASHSEED": "0"},
        check=False,
    )


if __name__ == "__main__":
    main()
