"""The agent as a ROS 2 package says of itself what pyproject.toml says."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import pytest

from testkit import ROOT

FOLDERS = ["contract", "device"]
# As rosdep calls them; it does not know the last two.
ROSDEP = {
    "iort-contract": "iort_contract", "PyYAML": "python3-yaml", "cryptography": "python3-cryptography",
    "awsiotsdk": None, "awscrt": None,
}  # fmt: skip
ROS = {"rclpy", "launch_ros"}
SETUP = """
import json, setuptools
from distutils.core import run_setup
found = run_setup("setup.py", stop_after="config")
names = ("entry_points", "packages", "package_data", "data_files")
values = {name: getattr(found, name) for name in names}
print(json.dumps({"name": found.get_name(), "version": found.get_version(), **values}))
"""


class Package(NamedTuple):
    folder: Path
    xml: ET.Element
    setup: dict[str, Any]
    project: Distribution

    def text(self, name: str) -> str:
        found = self.xml.find(name)
        assert found is not None
        return str(found.text)


@pytest.fixture(scope="module", params=FOLDERS)
def package(request: pytest.FixtureRequest) -> Package:
    folder = ROOT / request.param
    command = [sys.executable, "-B", "-c", SETUP]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return Package(
        folder, ET.parse(folder / "package.xml").getroot(), json.loads(done.stdout.splitlines()[-1]),
        distribution(f"iort-{'agent' if request.param == 'device' else request.param}"),
    )  # fmt: skip


def test_name_and_version_are_the_projects(package: Package) -> None:
    name, version = package.project.name, package.project.version
    assert (package.setup["name"], package.setup["version"]) == (name, version)
    assert (package.text("name"), package.text("version")) == (name.replace("-", "_"), version)
    assert package.text("description") == package.project.metadata["Summary"]
    assert package.text("license") == package.project.metadata["License"]
    assert package.text("export/build_type") == "ament_python"


def test_dependencies_are_the_projects_and_those_of_ros(package: Package) -> None:
    requires = [one for one in package.project.requires or () if "extra ==" not in one]
    needed = {re.split(r"[^\w-]", one)[0] for one in requires}
    named = {str(one.text) for one in package.xml.findall("exec_depend")}
    assert named - ROS == {ROSDEP[one] for one in needed} - {None}
    assert (named >= ROS) == (package.folder.name == "device")


def test_executables_are_the_projects_and_lie_where_ros2_run_looks(package: Package) -> None:
    scripts = [f"{one.name} = {one.value}" for one in package.project.entry_points]
    assert (package.setup["entry_points"] or {}).get("console_scripts", []) == scripts
    if scripts:
        assert "install_scripts = $base/lib/iort_agent\n" in (package.folder / "setup.cfg").read_text()


def test_every_package_and_every_file_of_the_index_is_installed(package: Package) -> None:
    name = package.text("name")
    inits = (package.folder / name).rglob("__init__.py")
    assert set(package.setup["packages"]) == {
        ".".join(init.parent.relative_to(package.folder).parts) for init in inits
    }
    files = dict(package.setup["data_files"])
    assert files["share/ament_index/resource_index/packages"] == [f"resource/{name}"]
    assert files[f"share/{name}"] == ["package.xml"]
    assert [one for some in files.values() for one in some if not (package.folder / one).is_file()] == []


def test_the_machines_files_are_the_wheels(package: Package) -> None:
    text = (package.folder / "pyproject.toml").read_text()
    files = [
        one for where, some in package.setup["data_files"] if where == "share/iort-agent" for one in some
    ]
    assert files == re.findall(r'"((?:systemd|udev)/[^"]+)"', text)
