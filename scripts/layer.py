"""Builds a layer into build/layer/<name>: the packages of its requirements, and their bytecode.

    python -m scripts.layer {local,lambda,analysis}

`lambda` is Lambda 1's for AWS, `local` the same for this machine; `analysis` has numpy and pyarrow for AWS.
On the embedded cloud functions see this machine's packages, and need no such layer.

The packages depend only on the target's Python and platform, not on this machine. Bytecode fits only one
version of Python, so that version is needed here; without it Lambda compiles at every cold start.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stacks import PLATFORM, PYTHON

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


@dataclass(frozen=True)
class Layer:
    """A layer: its target, its locked packages, and the patterns of their files that nothing of ours uses."""

    target: Target
    requirements: str
    unused: tuple[str, ...] = ()


# Together with the code a function may have 250 MB ("Lambda quotas"), and numpy and pyarrow have more. These
# are tests, what C compilers need, and Arrow's network clients. Arrow's other libraries need each other.
_UNUSED = (
    *("**/tests", "**/*.pyi", "**/*.pxd", "**/*.pyx", "**/*.pxi", "**/*.h", "**/*.hpp", "**/*.lib", "**/*.a"),
    *("pyarrow/include", "pyarrow/src", "numpy/_core/include", "numpy/f2py", "numpy/random/lib"),
    *("pyarrow/*flight*", "pyarrow/libarrow_s3*", "pyarrow/_s3fs*", "pyarrow/_gcsfs*", "pyarrow/_azurefs*"),
    # The same libraries by names that only a linker asks for.
    *("pyarrow/libarrow*.so", "pyarrow/libarrow*.so.*.*.*"),
)
LAYERS = {
    "local": Layer(LOCAL, "layer.txt"),
    "lambda": Layer(LAMBDA, "layer.txt"),
    "analysis": Layer(LAMBDA, "analysis-layer.txt", _UNUSED),
}


def main() -> None:
    """Build one layer."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("name", choices=LAYERS, help="which layer: for this machine, or for AWS")
    name = parser.parse_args().name
    layer = LAYERS[name]
    compiler = sys.executable if layer.target == LOCAL else interpreter(layer.target.python)
    if compiler is None:
        print(f"setup: no bytecode: Python {PYTHON} is missing here, and uv could not fetch it.")
        print("setup: Cold starts take longer. Install it, and run this again after")
        print(f"setup: rm build/setup/layer-{name}")
    build(ROOT / "build" / "layer" / name, layer, compiler)


def interpreter(version: str) -> str | None:
    """A Python of a version: this machine's, or one that uv fetches. None if there is neither."""
    code = "import sys; print(sys.executable)"
    command = [str(UV), "run", "--quiet", "--no-project", "--python", version, "python", "-c", code]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def build(folder: Path, layer: Layer, compiler: str | None) -> None:
    """Build the layer from scratch; raises `subprocess.CalledProcessError`."""
    shutil.rmtree(folder, ignore_errors=True)
    packages, target = folder / "python", layer.target
    platform = ["--python-platform", target.platform] if target.platform else []
    subprocess.run(
        [
            *(UV, "pip", "install", "--quiet", *LOCKED),
            *("--python", sys.executable, "--python-version", target.python, *platform),
            *("--target", packages, "--link-mode", "copy"),
            *("--requirements", ROOT / "requirements" / layer.requirements),
        ],
        check=True,
    )
    # Scripts start with this machine's Python path, and Lambda never calls them.
    shutil.rmtree(packages / "bin", ignore_errors=True)
    (packages / ".lock").unlink(missing_ok=True)
    trim(packages, layer.unused)
    if compiler is not None:
        compile_all(packages, compiler)


def trim(packages: Path, unused: Sequence[str]) -> None:
    """Remove the files and folders that these patterns name."""
    for path in sorted({path for pattern in unused for path in packages.glob(pattern)}):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            # It may have been in a folder that went before.
            path.unlink(missing_ok=True)


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
