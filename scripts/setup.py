"""Sets the checkout up: .venv, node_modules, the built page and Lambda 1's layer. Writes only inside it.

    python3 scripts/setup.py [--layer lambda] [--checkov] [--docs] [--oldest any|/path/to/python3.8]

It needs only Python 3.10 or newer with the venv module. It skips a step whose inputs are unchanged since its
last success, so another run is cheap.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
STAMPS = ROOT / "build" / "setup"
# The base interpreter, even if this runs in a virtual environment, such as the one created here.
BASE_PYTHON = Path(getattr(sys, "_base_executable", sys.executable)).resolve()
OLDEST = (3, 10)
# ROS Noetic's Python, for the robot.
OLDEST_OF_ROBOT = "3.8"
LEAST_FREE_BYTES = 3 * 1024**3
PYENV = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
PATH = os.environ.get("PATH", os.defpath)
ENVIRONMENT = {
    # The venv's own node and npm come before the machine's.
    "PATH": os.pathsep.join([str(ROOT / ".venv" / "bin"), PATH]),
    "npm_config_cache": str(ROOT / "build" / "npm-cache"),
    "npm_config_update_notifier": "false",
    "UV_PYTHON_INSTALL_DIR": str(ROOT / "build" / "python"),
    # pyenv's own before the path: its shims fail for a version that is not activated.
    "UV_PYTHON_SEARCH_PATH": os.pathsep.join([*map(str, sorted(PYENV.glob("*/bin"))), PATH]),
}
LOCKED = "--quiet --require-hashes --only-binary :all:"
SYNC = f".venv/bin/uv pip sync {LOCKED} --python"
# Without the network: the locked setuptools builds what comes from the checkout.
EDITABLE = (
    ".venv/bin/uv pip install --quiet --no-deps --no-build-isolation --editable contract --editable device"
)


class SetupError(Exception):
    """A step that failed; the text says what to do."""


class Step(NamedTuple):
    """Commands that run again when the ``inputs``, patterns below the checkout, have changed."""

    name: str
    title: str
    inputs: tuple[str, ...]
    commands: tuple[str, ...]
    advice: str = "Is the package registry reachable?"


def main() -> None:
    """Run the steps that are due."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--layer", choices=["lambda"], help="also build the layers that `cdk deploy` needs")
    parser.add_argument("--checkov", action="store_true", help="also install what `make check` needs")
    parser.add_argument("--docs", action="store_true", help="also install what `make docs` needs")
    parser.add_argument("--oldest", metavar="PYTHON", help="also install the robot's tests for Python 3.8")
    asked, began = parser.parse_args(), time.monotonic()
    try:
        check_machine()
        for step in steps(
            layer=bool(asked.layer), checkov=asked.checkov, docs=asked.docs, oldest=asked.oldest
        ):
            run(step, began)
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except KeyboardInterrupt:
        sys.exit("\nsetup: stopped; the same command goes on from here")


def steps(*, layer: bool, checkov: bool, docs: bool, oldest: str | None) -> Iterator[Step]:
    """Every step in its order."""
    base = shlex.quote(str(BASE_PYTHON))
    build = "--disable-pip-version-check --no-deps --no-compile -r requirements/build.txt"
    venv = (f"{base} -m venv --clear .venv", f".venv/bin/python -m pip install {LOCKED} {build}")
    yield Step("venv", "virtual environment", ("requirements/build.txt",), venv)
    # pubnub, which publishes no wheel, is pure Python. Modules are compiled on their first import: to compile
    # all of them here would take longest of all.
    packages = (
        f"{SYNC} .venv --no-binary pubnub --no-build-isolation requirements/dev.txt",
        f"{EDITABLE} --editable analysis --editable station --python .venv",
    )
    yield Step("python", "Python packages", ("requirements/dev.txt", "*/pyproject.toml"), packages)
    locked = "package-lock.json"
    yield Step("node", "CDK and page packages", (locked,), (".venv/bin/npm ci --no-progress",))
    yield Step("page", "live page", ("station/web/**/*", locked), (".venv/bin/npm run build",))
    made_of = ("requirements/layer.txt", "scripts/layer.py", "stacks/__init__.py")
    local = (".venv/bin/python -m scripts.layer local",)
    yield Step("layer-local", "Lambda layer, this machine", made_of, local)
    if layer:
        aws = (".venv/bin/python -m scripts.layer lambda",)
        yield Step("layer-lambda", "Lambda layer, AWS", made_of, aws)
        arrays = ("requirements/analysis-layer.txt", *made_of[1:])
        aws = (".venv/bin/python -m scripts.layer analysis",)
        yield Step("layer-analysis", "Lambda layer of numpy and pyarrow, AWS", arrays, aws)
    if checkov:
        apart = (
            f".venv/bin/uv venv --clear --python {base} build/checkov",
            f"{SYNC} build/checkov requirements/checkov.txt",
        )
        # Its requirements contradict ours.
        title = "checkov, in an environment of its own"
        yield Step("checkov", title, ("requirements/checkov.txt",), apart)
    if docs:
        site = (
            f".venv/bin/uv venv --clear --python {base} build/mkdocs",
            f"{SYNC} build/mkdocs requirements/docs.txt",
        )
        yield Step("docs", "mkdocs, in an environment of its own", ("requirements/docs.txt",), site)
    if oldest:
        python = OLDEST_OF_ROBOT if oldest == "any" else shlex.quote(oldest)
        right = f"import sys; assert '%d.%d' % sys.version_info[:2] == '{OLDEST_OF_ROBOT}', sys.version"
        robot = (
            f".venv/bin/uv venv --clear --python {python} build/oldest",
            f'build/oldest/bin/python -c "{right}"',
            f"{SYNC} build/oldest requirements/oldest.txt",
            f"{EDITABLE} --python build/oldest",
        )
        advice = (
            f"If Python {OLDEST_OF_ROBOT} is missing here, install it, or name it with `make test-oldest "
            f"OLDEST=/path/to/python{OLDEST_OF_ROBOT}`. Else: is the package registry reachable?"
        )
        inputs = ("requirements/oldest.txt", "contract/pyproject.toml", "device/pyproject.toml")
        yield Step("oldest", f"the robot's tests, for Python {OLDEST_OF_ROBOT}", inputs, robot, advice)


def check_machine() -> None:
    """Refuse a machine on which a later step would fail for an obscure reason."""
    if sys.version_info < OLDEST:
        wanted = ".".join(map(str, OLDEST))
        raise SetupError(
            f"Python must be {wanted} or newer, got {sys.version.split()[0]}: "
            "install a newer one and run `make setup PYTHON=python3.12`"
        )
    for module in ("venv", "ensurepip"):
        if importlib.util.find_spec(module) is None:
            raise SetupError(
                f"this Python has no {module} module: install it (Debian: `apt install python3-venv`)"
            )
    if not (ROOT / ".venv").exists() and shutil.disk_usage(ROOT).free < LEAST_FREE_BYTES:
        raise SetupError(f"{ROOT} must have {LEAST_FREE_BYTES // 1024**3} GB free: free some")


def run(step: Step, began: float) -> None:
    """Run a step's commands, unless they succeeded before with the same inputs and the same Python."""
    stamp, log = STAMPS / step.name, STAMPS / f"{step.name}.log"
    key = hashlib.sha256(f"{BASE_PYTHON} {sys.version} {step.commands}".encode())
    for path in sorted(path for pattern in step.inputs for path in ROOT.glob(pattern) if path.is_file()):
        key.update(str(path).encode() + path.read_bytes())
    if (ROOT / ".venv").exists() and stamp.exists() and stamp.read_text() == key.hexdigest():
        return
    if step.name == "venv":
        # A new environment has none of the packages that the other steps installed.
        shutil.rmtree(STAMPS, ignore_errors=True)
    STAMPS.mkdir(parents=True, exist_ok=True)
    # If a command fails half-way, the inputs of the last success may come back, but not its result.
    stamp.unlink(missing_ok=True)
    print(f"setup: {step.title} ...", end="", flush=True)
    step_began = time.monotonic()
    for command in step.commands:
        with log.open("wb") as output:
            done = subprocess.run(
                shlex.split(command),
                cwd=ROOT,
                env={**os.environ, **ENVIRONMENT},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                check=False,
            )
        said = log.read_text(errors="replace").splitlines()
        if done.returncode:
            tail = "\n".join(said[-15:])
            raise SetupError(f"`{command}` failed:\n{tail}\n{step.advice} Log: {log}")
        # Lines that begin so are for the user; the others stay in the log.
        print("".join(f"\n{line}" for line in said if line.startswith("setup: ")), end="", flush=True)
    stamp.write_text(key.hexdigest())
    now = time.monotonic()
    print(f" {now - step_began:.0f} s ({now - began:.0f} s so far)", flush=True)


if __name__ == "__main__":
    main()
