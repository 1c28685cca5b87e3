"""The wheels, installed away from the checkout: drive a car, query it, open the page."""

from __future__ import annotations

import json
from pathlib import Path
from urllib.request import urlopen

import pytest
import yaml

from iort_contract.catalog.vesc import VESC_STREAM
from iort_station.cloud import EMBEDDED
from local.cloud import EmbeddedCloud
from scripts import wheels
from testkit.waiting import until
from tests.installed import Installed

# It builds wheels and installs them into two environments.
pytestmark = pytest.mark.heavy
RATE_HZ, DRIVE_S = 20, 2


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    paths = wheels.build(tmp_path_factory.mktemp("dist"))
    return dict(zip(wheels.DISTRIBUTIONS, paths, strict=True))


@pytest.fixture(scope="module")
def agent(built: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(tmp_path_factory.mktemp("robot"), [built["contract"], built["device"]])


@pytest.fixture(scope="module")
def station(built: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return Installed(tmp_path_factory.mktemp("operator"), [built["contract"], built["station"]])


@pytest.fixture
def cloud(embedded: EmbeddedCloud) -> dict[str, str]:
    return {"IORT_EMBEDDED": str(embedded.folder / EMBEDDED.name)}


def test_an_installed_car_can_be_driven_queried_and_watched(agent, station, cloud):
    station.run("iort", "robots", "add", "wheels", **cloud)
    car = station.folder / "wheels" / "car.yaml"
    settings = yaml.safe_load(car.read_text())
    settings["sources"] = [{"type": "sim", "stream": VESC_STREAM, "rate_hz": RATE_HZ, "duration_s": DRIVE_S}]
    car.write_text(yaml.safe_dump(settings))
    agent.run("iort-agent", "check", "--config", car)
    agent.run("iort-agent", "run", "--config", car)

    def queried() -> list[str]:
        asked = ("query", "wheels", VESC_STREAM, "--last", "all", "--json")
        return station.run("iort", *asked, **cloud).splitlines()

    samples = until(lambda: (lines := queried()) and len(lines) == RATE_HZ * DRIVE_S and lines)
    assert "speed" in json.loads(samples[0])
    with station.start("iort", "dashboard", "--port", "0", **cloud) as dashboard:
        try:
            url = dashboard.stdout.readline().partition("#")[0]
            with urlopen(url) as page:
                assert "<title>" in page.read().decode()
            with urlopen(f"{url}page.js") as script:
                assert script.read()
            with urlopen(f"{url}vehicles.json") as vehicles:
                assert "wheels" in json.load(vehicles)["vehicles"]
        finally:
            dashboard.terminate()
    station.run("iort", "robots", "remove", "wheels", "--yes", **cloud)


def test_an_error_outside_a_checkout_explains_how_to_name_the_cloud(station):
    with station.start("iort", "--local", "robots", "list") as process:
        _, said = process.communicate()
    assert process.returncode == 1
    assert said.startswith("iort: no embedded cloud is running")


@pytest.mark.parametrize("command", ["iort-agent", "iort"])
def test_each_command_prints_its_version(agent, station, built, command):
    of = {"iort-agent": (agent, "device"), "iort": (station, "station")}
    environment, folder = of[command]
    _, version, *_ = built[folder].name.split("-")
    assert environment.run(command, "--version") == f"{command} {version}\n"


def test_the_robot_gets_its_unit_and_its_udev_rule(agent):
    shared = agent.bin.parent / "share" / "iort-agent"
    assert {path.name for path in shared.iterdir()} == {"iort-agent.service", "99-vesc.rules"}


def test_each_environment_lacks_the_other_ones_packages(agent, station):
    assert not (agent.site / "iort_station").exists()
    assert not (station.site / "iort_agent").exists()
    assert not (agent.site / "boto3").exists(), "an environment has only declared packages"
