"""Sets the checkout up: .venv, node_modules, the built page and Lambda 1's layer. Writes only inside it.

    python3 scripts/setup.py [--layer lambda] [--checkov] [--oldest any|/path/to/python3.8]

It needs only Python 3.10 or newer with the venv module. It skips steps whose inputs are unchanged since their
last success, so another run is cheap.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV, BUILD = ROOT / ".venv", ROOT / "build"
PYTHON, UV = VENV / "bin" / "python", VENV / "bin" / "uv"
# The base interpreter, even if this runs in a virtual environment, such as the one created here.
BASE_PYTHON = Path(getattr(sys, "_base_executable", sys.executable)).resolve()
OLDEST = (3, 10)
# ROS Noetic's Python, for the robot.
OLDEST_OF_ROBOT = "3.8"
LEAST_FREE_BYTES = 3 * 1024**3
# No compiler is needed: pubnub, which publishes no wheel, is pure Python.
# The build uses the locked setuptools of .venv, not today's newest.
LOCKED = (
    *("--require-hashes", "--no-deps", "--only-binary", ":all:"),
    *("--no-binary", "pubnub", "--no-build-isolation"),
)
# Each is installed from its folder.
DISTRIBUTIONS = ("contract", "device", "station")
STARTED = time.monotonic()
# npm and uv keep their own caches; our files stay inside the checkout.
CACHES = {"npm_config_cache": str(BUILD / "npm-cache"), "npm_config_update_notifier": "false"}


class SetupError(Exception):
    """A step that failed; the text says what to do."""


def main() -> None:
    """Run the steps that are due."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--layer", choices=["lambda"], help="also build the layer that `cdk deploy` needs")
    parser.add_argument("--checkov", action="store_true", help="also install what `make check` needs")
    parser.add_argument("--oldest", metavar="PYTHON", help="also install the robot's tests for Python 3.8")
    asked = parser.parse_args()
    try:
        check_machine()
        step("virtual environment", [], make_venv, stamp="venv")
        locked = [ROOT / "requirements" / name for name in ("build.txt", "dev.txt")]
        step("Python packages", locked, install_python, stamp="python")
        installed = [ROOT / folder / "pyproject.toml" for folder in DISTRIBUTIONS]
        step("the project itself", installed, install_project, stamp="project")
        step("CDK and page packages", [ROOT / "package-lock.json"], install_node, stamp="node")
        page = [*sorted((ROOT / "station" / "web").rglob("*")), ROOT / "package-lock.json"]
        step("live page", page, build_page, stamp="page")
        names = ("requirements/layer.txt", "scripts/layer.py", "stacks/parts/target.py")
        layer = [ROOT / name for name in names]
        step("Lambda layer, this machine", layer, lambda: build_layer("local"), stamp="layer-local")
        if asked.layer:
            step("Lambda layer, AWS", layer, build_layer_for_aws, stamp="layer-lambda")
        if asked.checkov:
            locked = [ROOT / "requirements" / "checkov.txt"]
            step("checkov, in an environment of its own", locked, install_checkov, stamp="checkov")
        if asked.oldest:
            locked = [ROOT / "requirements" / "oldest.txt", *installed]
            given = None if asked.oldest == "any" else asked.oldest
            title = f"the robot's tests, for Python {OLDEST_OF_ROBOT}"
            step(title, locked, lambda: install_oldest(given), stamp="oldest")
    except SetupError as error:
        sys.exit(f"setup: {error}")
    except KeyboardInterrupt:
        sys.exit("\nsetup: stopped; the same command goes on from here")


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


def step(title: str, inputs: Iterable[Path], action: Callable[[], None], *, stamp: str) -> None:
    """Run ``action`` unless it succeeded before with the same inputs."""
    mark = BUILD / "setup" / stamp
    key = hashlib.sha256(f"{BASE_PYTHON} {sys.version}".encode())
    for path in inputs:
        if path.is_file():
            key.update(str(path).encode() + path.read_bytes())
    if mark.exists() and mark.read_text() == key.hexdigest() and PYTHON.exists():
        return
    mark.parent.mkdir(parents=True, exist_ok=True)
    print(f"setup: {title} ...", end="", flush=True)
    began = time.monotonic()
    action()
    mark.write_text(key.hexdigest())
    now = time.monotonic()
    print(f" {now - began:.0f} s ({now - STARTED:.0f} s so far)", flush=True)


def make_venv() -> None:
    """Create .venv from scratch, with this Python."""
    shutil.rmtree(BUILD / "setup", ignore_errors=True)
    (BUILD / "setup").mkdir(parents=True)
    run([BASE_PYTHON, "-m", "venv", "--clear", VENV])


def install_python() -> None:
    """Install the locked packages; every file is checked against its hash.

    Python compiles a module on its first import. Compiling all of them here took longer than everything else,
    and most are never imported.
    """
    # Install uv first; pip comes with Python.
    pip = ("-m", "pip", "--disable-pip-version-check", "--quiet", "install", "--no-compile")
    run([PYTHON, *pip, *LOCKED[:4], "-r", "requirements/build.txt"])
    install(VENV, *LOCKED, "-r", "requirements/dev.txt")


def install_project() -> None:
    """Install iort-agent and iort into .venv/bin, editable from the checkout."""
    editable = [part for folder in DISTRIBUTIONS for part in ("--editable", folder)]
    install(VENV, "--no-deps", "--no-build-isolation", *editable)


def install_node() -> None:
    """Install the packages of package-lock.json, with the npm from PyPI."""
    run([VENV / "bin" / "npm", "ci", "--no-progress"])


def build_page() -> None:
    """Bundle the live page into the station."""
    run([VENV / "bin" / "npm", "run", "build"])


def build_layer(target: str, *more: str) -> None:
    """Build Lambda 1's layer for this machine or for AWS: scripts/layer.py, which runs in .venv."""
    run([PYTHON, "-m", "scripts.layer", target, *more])


def build_layer_for_aws() -> None:
    """Build the layer with bytecode, if Lambda's version of Python is available."""
    version = re.findall(r'^PYTHON = "(.+)"', (ROOT / "stacks" / "target.py").read_text(), re.MULTILINE)[0]
    try:
        compiler = ["--compiler", python_of(version)]
    except SetupError:
        compiler = []
        print(f" without bytecode: Python {version} is missing here, and uv could not fetch it.")
        print("setup: Cold starts take longer. To fix it, install that Python and remove")
        print("setup: build/setup/layer-lambda ...", end="", flush=True)
    build_layer("lambda", *compiler)


def install_checkov() -> None:
    """Install checkov, whose requirements contradict ours, into build/checkov."""
    run([UV, "venv", "--clear", "--python", BASE_PYTHON, BUILD / "checkov"])
    install(BUILD / "checkov", *LOCKED, "-r", "requirements/checkov.txt")


def install_oldest(given: str | None) -> None:
    """Install the agent and its tests for the oldest Python of a robot, into build/oldest."""
    try:
        python = given or python_of(OLDEST_OF_ROBOT)
    except SetupError as error:
        raise SetupError(
            f"Python {OLDEST_OF_ROBOT} is missing here, and uv could not fetch it: install it, or name it "
            f"with `make test-oldest OLDEST=/path/to/python{OLDEST_OF_ROBOT}`\n{error}"
        ) from error
    if version_of(python) != OLDEST_OF_ROBOT:
        raise SetupError(f"{python} must be Python {OLDEST_OF_ROBOT}")
    run([UV, "venv", "--clear", "--python", python, BUILD / "oldest"])
    install(BUILD / "oldest", *LOCKED[:4], "-r", "requirements/oldest.txt")
    robot = ("--editable", "contract", "--editable", "device")
    install(BUILD / "oldest", "--no-deps", "--no-build-isolation", *robot)


def python_of(version: str) -> str:
    """An interpreter of a version: this machine's, or one that uv fetches into build/. Raises
    `SetupError`."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    # pyenv's own before the path: pyenv's shims fail for a version that is not activated.
    places = [*map(str, sorted(pyenv.glob("*/bin"))), os.environ.get("PATH", os.defpath)]
    os.environ["UV_PYTHON_SEARCH_PATH"] = os.pathsep.join(places)
    os.environ["UV_PYTHON_INSTALL_DIR"] = str(BUILD / "python")
    find: list[str | Path] = [UV, "python", "find", "--system", "--no-python-downloads", version]
    try:
        return last_line(run(find))
    except SetupError:
        run([UV, "python", "install", "--no-bin", version])
        return last_line(run(find))


def version_of(python: str) -> str:
    """A Python's version, such as 3.8; empty if it is not a Python."""
    try:
        return last_line(run([python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]))
    except (OSError, SetupError):
        return ""


def last_line(text: str) -> str:
    """The last line of a program's output, after its warnings."""
    return text.rstrip().rpartition("\n")[2]


def install(environment: Path, *arguments: str) -> None:
    """Install into a virtual environment, with uv."""
    run([UV, "pip", "install", "--quiet", "--python", environment / "bin" / "python", *arguments])


def run(command: Sequence[str | Path]) -> str:
    """Run a command and return its output; raises `SetupError` with the end of the output if it fails."""
    log = BUILD / "setup" / "log"
    log.parent.mkdir(parents=True, exist_ok=True)
    # The venv's own node and npm come before the machine's.
    path = f"{VENV / 'bin'}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
    with log.open("wb") as output:
        done = subprocess.run(
            list(map(str, command)),
            cwd=ROOT,
            env={**os.environ, "PATH": path, **CACHES},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            check=False,
        )
    said = log.read_text(errors="replace")
    if done.returncode:
        tail = "\n".join(said.splitlines()[-15:])
        shown = " ".join(map(str, command))
        raise SetupError(f"`{shown}` failed:\n{tail}\nIs the package registry reachable? Log: {log}")
    return said


if __name__ == "__main__":
    main()
