"""The wheelhouses for robots without a network: complete for each Python, and installed by install.sh.

`make release WHEELHOUSE=1` runs this on those of dist/ (IORT_DIST); otherwise the tests make them.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
import tarfile
from pathlib import Path
from zipfile import ZipFile

import pytest

from scripts import release, wheelhouse
from testkit import ROOT
from tests.local.commands.test_release import IMPORT_ALL, ROS, UV, ran

# It downloads some 400 MB from the package index, unless pip has them in its cache.
pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module", params=wheelhouse.ARCHITECTURES)
def house(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The unpacked wheelhouse of an architecture."""
    folder = tmp_path_factory.mktemp(request.param)
    dist = Path(os.environ.get("IORT_DIST") or folder)
    made = next(dist.glob(f"iort-wheelhouse-*-{request.param}.tar"), None)
    archive = made or wheelhouse.make(request.param, release.build(folder), folder)
    with tarfile.open(archive) as packed:
        packed.extractall(folder, filter="data")
    (found,) = (path for path in folder.iterdir() if path.is_dir())
    return found


# The ELF header's number of a machine.
ELF = {"aarch64": 183, "x86_64": 62}


def test_a_wheelhouse_has_all_that_each_python_of_its_architecture_needs(house, tmp_path):
    architecture = house.name.rpartition("-")[2]
    assert {path.suffix for path in house.iterdir()} == {".whl", ".sh", ".txt"}
    install = f"pip install --offline --no-index --find-links {house} --only-binary :all: --dry-run".split()
    install += f"--target {tmp_path} --require-hashes --requirement {house}/requirements.txt".split()
    for python in wheelhouse.PYTHONS:
        target = f"--python-version {python}.10 --python-platform {architecture}-manylinux_2_31".split()
        # Fails if anything is missing here, or in the list with the hashes.
        ran(UV, *install, *target)
    heads = []
    for wheel in house.glob("*.whl"):
        with ZipFile(wheel) as packed:
            heads += [packed.read(name)[:20] for name in packed.namelist() if re.search(r"\.so(\.|$)", name)]
    assert len(heads) > len(wheelhouse.PYTHONS)
    machines = {(head[:4], int.from_bytes(head[18:20], "little")) for head in heads}
    assert machines == {(b"\x7fELF", ELF[architecture])}


# Nowhere to go, should something ask an index after all.
OFFLINE = {"https_proxy": "http://127.0.0.1:9", "http_proxy": "http://127.0.0.1:9"}


def installed(
    house: Path, environment: Path, python: Path | str = sys.executable
) -> subprocess.CompletedProcess[str]:
    """What install.sh said."""
    settings = {**os.environ, **OFFLINE, "PYTHON": str(python)}
    command = ["sh", house / "install.sh", environment]
    return subprocess.run(command, env=settings, capture_output=True, text=True, check=False)


def test_a_wheelhouse_is_installed_without_a_network_on_its_architecture_alone(house, tmp_path):
    if platform.machine() not in house.name:
        refused = installed(house, tmp_path)
        assert (refused.returncode, refused.stdout) == (1, "")
        assert refused.stderr.startswith("install.sh: these packages are for ")
        return
    oldest = ROOT / "build" / "oldest" / "bin" / "python"
    for python in filter(Path.exists, (oldest, Path(sys.executable))):
        environment = tmp_path / python.parts[-3]
        assert installed(house, environment, python).stdout == f"iort-agent {release.version()}\n"
        ran(environment / "bin" / "python", "-c", IMPORT_ALL, ",".join(ROS), "iort_contract,iort_agent")
    # Again, with a file that is not what was released.
    wheel = next(house.glob("iort_agent-*.whl"))
    wheel.write_bytes(wheel.read_bytes() + b"\0")
    ran(environment / "bin" / "python", "-m", "pip", "uninstall", "--yes", "iort-agent")
    refused = installed(house, environment, python)
    assert refused.returncode == 1
    assert "THESE PACKAGES DO NOT MATCH THE HASHES" in refused.stderr
    assert not (environment / "bin" / "iort-agent").exists()


def test_a_python_that_is_too_old_is_refused(house, tmp_path):
    if platform.machine() not in house.name:
        return
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.7.16 || exit 1\n')
    python.chmod(0o755)
    refused = installed(house, tmp_path / "environment", python)
    assert (refused.returncode, refused.stderr) == (
        1,
        "install.sh: Python must be 3.8 to 3.13, got Python 3.7.16: name another, PYTHON=/path/to/python3\n",
    )
