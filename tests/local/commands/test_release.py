"""The released packages, installed away from the checkout: the manual's commands, and the page.

`make release` runs this on dist/ (IORT_DIST); otherwise the tests build what they look at.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from urllib.request import urlopen

import pytest

from iort_station.cloud import EMBEDDED
from local.cloud import EmbeddedCloud
from scripts import release
from testkit import ROOT
from testkit.waiting import until

# It builds packages and installs them; those of others come from the package index, or uv's cache.
pytestmark = pytest.mark.heavy
UV = Path(sys.executable).parent / "uv"
# What only a machine with ROS has.
ROS = ("rospy", "roslib", "rosgraph", "genpy", "rclpy", "rosidl_runtime_py", "launch", "launch_ros")
IMPORT_ALL = """
import importlib, pkgutil, sys
for name in sys.argv[2].split(","):
    package = importlib.import_module(name)
    for module in pkgutil.walk_packages(package.__path__, name + "."):
        try:
            module.name.endswith("__main__") or importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            if error.name.partition(".")[0] not in sys.argv[1].split(","):
                raise
"""
# Commands of the manual that do not just end well: another test has the first.
DASHBOARD, RUN, INIT, AUDIT = "iort dashboard", "iort-agent run ", "iort-agent init ", "iort audit "


class Installed:
    """An environment with wheels and what they declare, at the checkout's versions.

    Commands run in an empty folder.
    """

    def __init__(self, folder: Path, *wheels: object) -> None:
        self.bin, self.folder = folder / "environment" / "bin", folder / "empty"
        self.folder.mkdir(parents=True)
        ran(UV, "venv", "--quiet", "--python", sys.executable, folder / "environment")
        python = self.bin / "python"
        ran(
            UV,
            "pip",
            "install",
            "--quiet",
            "--python",
            python,
            "--constraint",
            ROOT / "requirements/dev.txt",
            *wheels,
        )
        (self.site,) = (folder / "environment" / "lib").glob("python3*/site-packages")

    def start(self, command: str, *arguments: object, **environment: str) -> subprocess.Popen[str]:
        """Start a command of the environment, without the test runner's settings."""
        return subprocess.Popen(
            [str(self.bin / command), *map(str, arguments)],
            cwd=self.folder,
            env={
                "HOME": str(self.folder),
                "PATH": f"{self.bin}{os.pathsep}{os.defpath}",
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
        assert process.returncode == 0, output + errors
        return output


def ran(*command: object, **environment: str) -> str:
    done = subprocess.run(
        list(map(str, command)),
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(os.environ.get("IORT_DIST") or tmp_path_factory.mktemp("dist"))
    if not any(folder.iterdir()):
        release.build(folder)
    return folder


@pytest.fixture(scope="module")
def wheels(dist: Path) -> dict[str, str]:
    """The wheels by their distributions, each with all its extras."""
    found = {}
    for path in dist.glob("*.whl"):
        (metadata,) = distributions(path=[str(path)])
        extras = ",".join(metadata.metadata.get_all("Provides-Extra") or [])
        found[metadata.name] = f"{metadata.name}[{extras}] @ {path.as_uri()}"
    return found


@pytest.fixture(scope="module")
def agent(wheels: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(tmp_path_factory.mktemp("robot"), wheels["iort-contract"], wheels["iort-agent"])


@pytest.fixture(scope="module")
def station(wheels: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Installed:
    parts = [wheels[f"iort-{part}"] for part in ("contract", "analysis", "station")]
    return Installed(tmp_path_factory.mktemp("operator"), *parts)


@pytest.fixture
def cloud(embedded: EmbeddedCloud) -> dict[str, str]:
    return {"IORT_EMBEDDED": str(embedded.folder / EMBEDDED.name)}


def test_what_is_built_passes_the_checks_of_the_index(dist):
    files = [*dist.glob("*.whl"), *dist.glob("*.tar.gz")]
    assert len(files) == 2 * len(release.DISTRIBUTIONS)
    release.check(files)


def test_the_same_commit_gives_the_same_bytes(dist, tmp_path):
    usual = os.umask(0o077)
    try:
        again = release.build(tmp_path)
    finally:
        os.umask(usual)
    assert {path.name: path.read_bytes() for path in again} == {
        path.name: (dist / path.name).read_bytes() for path in again
    }


def test_every_module_of_the_wheels_is_imported_by_what_they_declare(agent, station):
    agent.run("python", "-c", IMPORT_ALL, ",".join(ROS), "iort_contract,iort_agent")
    station.run("python", "-c", IMPORT_ALL, ",".join(ROS), "iort_contract,iort_analysis,iort_station")


def manual(page: str, language: str = "sh") -> list[str]:
    """The commands of iort, or the programs, that a page tells to run, with other names for its robots."""
    text = re.sub(r"\bcar([17])\b", r"manual\1", (ROOT / page).read_text())
    blocks = re.findall(rf"(?ms)^```{language}\n(.*?)^```", text)
    if language != "sh":
        return blocks
    lines = [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith(("iort ", "iort-agent "))]


def test_the_commands_of_the_readme_and_of_the_first_robot_work(agent, station, cloud, request):
    both = {**cloud, "PATH": f"{station.bin}{os.pathsep}{agent.bin}{os.pathsep}{os.defpath}"}

    def typed(command: str, *statuses: int) -> str:
        with station.start("/bin/sh", "-c", command, **both) as process:
            output, errors = process.communicate()
        assert process.returncode in (statuses or (0,)), f"{command}\n{output}{errors}"
        return output + errors

    commands = list(dict.fromkeys([*manual("README.md"), *manual("docs/tutorials/first-robot.md")]))
    assert {command.split()[0] for command in commands} == {"iort", "iort-agent"}
    drives: list[subprocess.Popen[str]] = []

    def drive(robot: str) -> None:
        drives.append(station.start("/bin/sh", "-c", f"exec {RUN}--config bundles/{robot}/car.yaml", **both))
        request.addfinalizer(drives[-1].kill)
        queried = f"iort query {robot} vesc --last all --json"
        until(lambda: typed(queried, 0, 1).count("\n") > 100 or drives[-1].poll() is not None)

    # The demo's car, which the manual compares with.
    typed("iort robots add manual1 --out bundles")
    drive("manual1")
    for command in commands:
        if command.startswith(RUN) and len(drives) < 2:
            drive("manual7")
        elif command.startswith(INIT):
            assert "nothing to record; the agent's Python cannot import rclpy" in typed(command, 1)
        elif not command.startswith((DASHBOARD, RUN, AUDIT)):
            typed(command)
    for program in manual("README.md", "python"):
        station.run("python", "-c", program, **cloud)
    for process in drives:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate()
        assert process.returncode == 0, output + errors
    for command in commands:
        if command.startswith(AUDIT):
            typed(command)
    typed("iort robots remove manual1 --yes && iort robots remove manual7 --yes")
    assert (station.folder / "ride.mcap").stat().st_size
    assert (station.folder / "cars.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_is_in_the_stations_wheel(station, cloud):
    with station.start("iort", "dashboard", "--port", "0", **cloud) as dashboard:
        try:
            url = dashboard.stdout.readline().partition("#")[0]
            with urlopen(url) as page:
                assert "<title>" in page.read().decode()
            with urlopen(f"{url}page.js") as script:
                assert script.read()
            with urlopen(f"{url}vehicles.json") as vehicles:
                assert "vehicles" in json.load(vehicles)
        finally:
            dashboard.terminate()


def test_the_pages_that_programs_read_are_in_the_stations_wheel(station):
    listed = "from iort_station.mcp import documents; print(*documents().values())"
    pages = station.run("python", "-c", listed).split()
    assert str(station.site / "iort_station" / "documents" / "reference" / "queries.md") in pages


def test_an_error_outside_a_checkout_explains_how_to_name_the_cloud(station):
    with station.start("iort", "--local", "robots", "list") as process:
        _, said = process.communicate()
    assert process.returncode == 1
    assert said.startswith("iort: no embedded cloud is running")


def test_each_command_prints_the_version(agent, station):
    assert agent.run("iort-agent", "--version") == f"iort-agent {release.version()}\n"
    assert station.run("iort", "--version") == f"iort {release.version()}\n"


def test_the_robot_gets_its_unit_and_its_udev_rule(agent):
    shared = agent.bin.parent / "share" / "iort-agent"
    assert {path.name for path in shared.iterdir()} == {"iort-agent.service", "99-vesc.rules"}


def test_each_environment_lacks_the_other_ones_packages(agent, station):
    assert not (agent.site / "iort_station").exists()
    assert not (station.site / "iort_agent").exists()
    assert not (agent.site / "boto3").exists(), "an environment has only declared packages"
