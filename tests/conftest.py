"""What every test shares: the synthesized app, what a skip means, and who runs beside whom."""

from __future__ import annotations

import os
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from local import patched
from tests.browser import browser, open_page  # noqa: F401 - fixtures

# How long an example takes says something about the machine only.
settings.register_profile("iort", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("iort")

# What shares something costly runs in one worker of `make test`: an embedded cloud, of which there are two
# because the faults spend their time waiting; the demo, which starts its own; what synthesizes the app.
# Paths or their beginnings, the first that fits.
GROUPS = {
    "tests/local/test_demo.py": "demo",
    "tests/local/test_faults.py": "faults",
    "tests/local/test_faults_ros.py": "faults",
    "tests/local/test_uplink.py": "faults",
    "tests/local/test_pubnub": "pubnub",
    "tests/local/": "cloud",
    "tests/ros/test_mixed_robot.py": "faults",
    "tests/ros/test_two_publishers.py": "faults",
    "tests/ros/test_two_robots.py": "cloud",
    "tests/stacks/": "app",
    **dict.fromkeys(
        [
            "tests/unit/functions/test_admit.py",
            "tests/unit/functions/test_alert.py",
            "tests/unit/functions/test_presence.py",
            "tests/unit/functions/test_quarantine.py",
            "tests/unit/functions/test_query.py",
            "tests/unit/functions/test_summarize_drive.py",
            "tests/unit/functions/test_tables.py",
            "tests/unit/functions/test_upload.py",
            "tests/unit/station/test_adopt.py",
            "tests/unit/station/test_data.py",
        ],
        "app",
    ),
    "tests/web/": "page",
}


def group(nodeid: str) -> str:
    """What runs in one worker, in order: a group, a test of a ROS graph of its own, or a file."""
    for path, name in GROUPS.items():
        if nodeid.startswith(path):
            return name
    return nodeid if nodeid.startswith("tests/ros/") else nodeid.split("::", 1)[0]


def pytest_configure() -> None:
    """Tests import the ministack that the embedded cloud runs: the installed one with local/patches/."""
    if find_spec("ministack"):
        patched.use()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under `make test`, groups are spread over the workers. (Marks cannot say it: of xdist 3.8, they
    no longer reach the scheduler under pytest 9.)"""
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):  # type: ignore[misc]  # xdist has no types for us
        def _split_scope(self, nodeid: str) -> str:
            return group(nodeid)

    return Groups(config, log)


def skips_fail() -> bool:
    return os.environ.get("REQUIRE_ALL", "").lower() in {"1", "true", "yes"}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, Any, Any]:
    """REQUIRE_ALL=1: a machine that is said to have everything has nothing to skip."""
    report = yield
    return failed_if_skipped(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, Any]:
    report = yield
    return failed_if_skipped(report)


def failed_if_skipped(report: Any) -> Any:
    # An expected failure is reported as skipped, and is none.
    if report.skipped and skips_fail() and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"REQUIRE_ALL is set, and this was skipped: {reason}"
    return report


@dataclass(frozen=True)
class Synthesized:
    """The app as it is deployed: a template a stack, the folder with the assets, which stacks are
    protected from termination, and the paths of what the checkers' findings are acknowledged on."""

    folder: Path
    templates: Mapping[str, dict[str, Any]]
    protected: set[str]
    acknowledged: set[str]

    def resources(self, kind: str, stack: str | None = None) -> dict[str, dict[str, Any]]:
        """Logical id to properties of every resource of a type."""
        return {
            name: resource.get("Properties", {})
            for noun, template in self.templates.items()
            for name, resource in template["Resources"].items()
            if resource["Type"] == kind and stack in (None, noun)
        }

    def asset(self, key: dict[str, Any]) -> Path:
        """The folder that a resource's S3Key was made from."""
        return self.folder / f"asset.{key['S3Key'].removesuffix('.zip')}"


@pytest.fixture(scope="session")
def synthesized(tmp_path_factory: pytest.TempPathFactory) -> Synthesized:
    """app.build for stage dev, with what is set for the account as a whole."""
    return _synthesize(tmp_path_factory, device_defender=True, iot_log_level="error")


@pytest.fixture(scope="session")
def production(tmp_path_factory: pytest.TempPathFactory) -> Synthesized:
    """app.build with everything that a production stage can have."""
    return _synthesize(
        tmp_path_factory,
        stage="prod",
        customer_key=True,
        budget_usd=50,
        alarm_email="lab@example.org",
        tags={"team": "lab"},
        device_defender=True,
        iot_log_level="error",
        robot_metrics=True,
    )


def _synthesize(tmp_path_factory: pytest.TempPathFactory, **given: Any) -> Synthesized:
    # Imported here, because CDK takes seconds to load.
    from aws_cdk import App

    from app import build
    from stacks.settings import Settings

    layer, folder = tmp_path_factory.mktemp("layer"), tmp_path_factory.mktemp("cdk.out")
    (layer / "python").mkdir()
    (layer / "python" / "nothing.py").touch()
    app = App(outdir=str(folder))
    settings = Settings(layer=layer, **given)
    acknowledged = build(app, settings)
    stacks = app.synth().stacks
    prefix = f"{settings.namespace}-"
    nouns = {s.stack_name.removeprefix(prefix): s for s in stacks}
    return Synthesized(
        folder,
        {noun: s.template for noun, s in nouns.items()},
        {noun for noun, s in nouns.items() if s.termination_protection},
        {one.path for one in acknowledged},
    )
