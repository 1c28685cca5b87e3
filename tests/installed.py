"""Environments with one wheel each, isolated from the checkout except for the locked dependencies.

No network is needed: each declared dependency is linked, file by file, from the checkout's environment.
Undeclared packages are missing.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from collections.abc import Iterable, Iterator
from importlib.metadata import Distribution, distribution, distributions
from pathlib import Path

from packaging.requirements import Requirement

OURS = re.compile(r"iort-(contract|agent|station)")
# Packages that a ROS workspace or a checkout may have on the path beside the installed ones.
DECOYS = ("device", "contract", "analysis", "station", "functions", "stacks", "local", "bench")


class Installed:
    """An environment with wheels and their declared dependencies. Commands run in an empty folder, with
    decoys on PYTHONPATH.
    """

    def __init__(self, folder: Path, wheels: Iterable[Path]) -> None:
        self.bin = folder / "environment" / "bin"
        self.folder = folder / "empty"
        self.folder.mkdir(parents=True)
        self._decoys = folder / "decoys"
        for name in DECOYS:
            (self._decoys / name).mkdir(parents=True)
            (self._decoys / name / "__init__.py").write_text(f"raise RuntimeError('the decoy {name}')\n")
        uv = Path(sys.executable).parent / "uv"
        environment = folder / "environment"
        _run(uv, "venv", "--quiet", "--offline", "--python", sys.executable, environment)
        _run(
            *(uv, "pip", "install", "--quiet", "--offline", "--no-deps"),
            *("--python", self.bin / "python", *wheels),
        )
        self.site = Path(_run(self.bin / "python", "-c", "import site; print(site.getsitepackages()[0])"))
        ours = {one.name: one for one in distributions(path=[str(self.site)]) if OURS.fullmatch(one.name)}
        for needed in _needed(ours):
            _link(needed, self.site)

    def start(self, command: str, *arguments: object, **environment: str) -> subprocess.Popen[str]:
        """Start a command of the environment, without the test runner's settings."""
        return subprocess.Popen(
            [str(self.bin / command), *map(str, arguments)],
            cwd=self.folder,
            env={
                "HOME": str(self.folder),
                "PATH": f"{self.bin}{os.pathsep}{os.defpath}",
                "PYTHONPATH": str(self._decoys),
                "PYTHONUNBUFFERED": "1",
                **environment,
            },
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, command: str, *arguments: object, **environment: str) -> str:
        """Run a command that must succeed; return its output."""
        with self.start(command, *arguments, **environment) as process:
            output, errors = process.communicate()
        assert process.returncode == 0, errors
        return output


def _needed(ours: dict[str, Distribution]) -> Iterator[Distribution]:
    """Return the declared distributions, and their dependencies in turn."""
    waiting = [(one, frozenset[str]()) for one in ours.values()]
    seen = set(waiting)
    while waiting:
        one, extras = waiting.pop()
        for text in one.requires or ():
            requirement = Requirement(text)
            marker = requirement.marker
            if marker and not any(marker.evaluate({"extra": extra}) for extra in {"", *extras}):
                continue
            if OURS.fullmatch(requirement.name):
                assert requirement.name in ours, f"{one.name} needs {requirement.name}"
                continue
            found = distribution(requirement.name)
            assert found.version in requirement.specifier, f"{one.name} needs {text}"
            wanted = (found, frozenset(requirement.extras))
            if (found.name, wanted[1]) not in {(each.name, its) for each, its in seen}:
                seen.add(wanted)
                waiting.append(wanted)
                yield found


def _link(one: Distribution, site: Path) -> None:
    for file in one.files or ():
        if ".." in file.parts or file.suffix == ".pyc":
            continue
        link = site / file
        link.parent.mkdir(parents=True, exist_ok=True)
        if not link.exists():
            link.symlink_to(Path(sysconfig.get_path("purelib")) / file)


def _run(*command: object) -> str:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()
