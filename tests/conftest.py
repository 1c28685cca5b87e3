"""Fixtures and rules of all tests: the synthesized app, skips as failures, groups of a worker."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections import Counter
from collections.abc import Generator, Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from local.emulator import package
from testkit.ros2 import ABSENT
from tests.browser import browser, open_page  # noqa: F401 - fixtures

# The duration of an example depends only on the machine.
settings.register_profile("iort", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("iort")
# `make test-fast`; CI generates the usual number. tests/examples.py scales a test's own number with it.
settings.register_profile("fast", settings.get_profile("iort"), max_examples=10, stateful_step_count=10)

# Libraries set names of their own as they load, and the station names its clouds' hosts in no_proxy.
_OURS = ("AWS_", "HOME", "IORT_", "PATH", "PYTHONPATH", "TMPDIR", "TZ")
_SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)

# Tests that share something costly run in one worker of `make test`: an embedded cloud, the demo, which
# starts its own cloud, the synthesized app. They start first, in this order: a long group that starts last
# runs alone. A node id's beginning decides, and the first that fits; a group runs in the order of its paths
# here. Without a name each file is a group, but starts early all the same: those of the browser are long.
GROUPS = {
    "tests/local/commands/test_demo.py": "demo",
    # Two graphs of ROS 2 at once take the time of one another's discovery.
    "tests/ros2/": "ROS 2",
    # All tests of a ROS look at one drive of minutes.
    "tests/ros/recorder/": "ROS 2",
    "tests/local/commands/": "cloud of the data",
    # Before the others have raised the alarms that it waits for.
    "tests/local/operations/test_eyes.py": "cloud of the data",
    "tests/local/data/": "cloud of the data",
    "tests/ros/test_two_robots.py": "cloud of the data",
    # It analyses every drive that the cloud has.
    "tests/local/analysis/": "cloud of the faults",
    "tests/local/operations/": "cloud of the faults",
    "tests/local/page/": "cloud of the faults",
    "tests/local/faults/": "cloud of the faults",
    "tests/ros/mixed/test_mixed_robot.py": "cloud of the faults",
    "tests/ros/test_two_publishers.py": "cloud of the faults",
    "tests/local/emulator/": "cloud of the robots",
    "tests/local/network/test_network.py": "kept cloud",
    "tests/local/network/": "cloud of the robots",
    "tests/local/identity/": "cloud of the robots",
    "tests/local/robots/": "cloud of the robots",
    # All tests of the proof look at one drive of minutes.
    "tests/video/": "cloud of the robots",
    "tests/web/": "",
    "tests/stacks/": "app",
    "tests/unit/functions/test_admit.py": "app",
    "tests/local/pubnub/": "PubNub",
}


def group(nodeid: str) -> str:
    """Return the tests that run in one worker, in order: a group, a test with its own ROS graph, or a
    file.
    """
    for path, name in GROUPS.items():
        if name and nodeid.startswith(path):
            return name
    return nodeid if nodeid.startswith("tests/ros/") else nodeid.split("::", 1)[0]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the tests of the groups first."""
    order = {name: i for i, name in enumerate(dict.fromkeys(GROUPS.values()))}
    paths = list(GROUPS)

    def place(nodeid: str) -> tuple[int, int]:
        path = next((i for i, path in enumerate(paths) if nodeid.startswith(path)), len(paths))
        return order[GROUPS[paths[path]]] if path < len(paths) else len(order), path

    items.sort(key=lambda item: place(item.nodeid))


def pytest_configure() -> None:
    """Let tests import the ministack of the embedded cloud: the installed one with local/patches/."""
    # The CDK's own validation only warns, and is most of a synthesis. `make check` has it.
    os.environ["CDK_VALIDATION"] = "false"
    # The environment's Node: the machine may have none.
    os.environ["JSII_NODE"] = str(Path(sys.executable).with_name("node"))
    # Threads of PubNub's SDK outlive their client, and would log into later tests.
    logging.getLogger("pubnub").propagate = False
    if find_spec("ministack"):
        package.use()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Under `make test`, spread the groups over the workers. (Marks cannot do this: xdist 3.8's marks no
    longer reach the scheduler under pytest 9.)
    """
    from xdist.scheduler import LoadScopeScheduling

    class Groups(LoadScopeScheduling):  # type: ignore[misc]  # xdist has no types for us
        def _split_scope(self, nodeid: str) -> str:
            return group(nodeid)

    return Groups(config, log)


@pytest.fixture(autouse=True, scope="session")
def services_read_once() -> Iterator[None]:
    """botocore reads megabytes of JSON about its services for each new session; in tests all share it."""
    if not find_spec("botocore"):
        yield
        return
    import botocore.session

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(botocore.session, "create_loader", lru_cache(botocore.session.create_loader))
        yield


@pytest.fixture(autouse=True)
def process_as_before() -> Iterator[None]:
    """A test that leaves a logger silent or a variable set would change those after it in its process."""
    before = _process()
    yield
    assert _process() == before, "the test, or the code that it ran, left its process changed"


def _process() -> dict[str, object]:
    """What all tests of a process share: logging, the environment, the working folder, the signals."""
    manager = logging.Logger.manager
    loggers = {
        name: (log.level, log.propagate, log.disabled)
        for name, log in list(manager.loggerDict.items())
        if name.startswith(("iort", "foxglove")) and isinstance(log, logging.Logger)
    }
    return {
        "logging": (logging.getLogger().level, manager.disable),
        # A logger is as good as none until it is set.
        "loggers": {name: state for name, state in loggers.items() if state != (logging.NOTSET, True, False)},
        "environment": {name: value for name, value in os.environ.items() if name.startswith(_OURS)},
        "folder": Path.cwd(),
        "signals": {number: signal.getsignal(number) for number in _SIGNALS},
    }


# What no registry has, or only with 8 GB of packages: the reason of a test that is skipped without it.
NO_LEROBOT = "IORT_LEROBOT names no Python that has lerobot"
LEFT_OUT = {"ROS 2": ABSENT, "LeRobot": NO_LEROBOT}


def skips_fail() -> bool:
    return os.environ.get("REQUIRE_ALL", "").lower() in {"1", "true", "yes"}


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, Any, Any]:
    """REQUIRE_ALL=1: a complete machine has no reason to skip a test, except for what `LEFT_OUT` names."""
    report = yield
    return failed_if_skipped(report)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report() -> Generator[None, Any, Any]:
    report = yield
    return failed_if_skipped(report)


def failed_if_skipped(report: Any) -> Any:
    # An expected failure is reported as skipped, but is not a skip.
    if report.skipped and skips_fail() and not hasattr(report, "wasxfail") and not left_out(report):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"REQUIRE_ALL is set, and this was skipped: {reason}"
    return report


def left_out(report: Any) -> str:
    """What the machine lacks for a skipped test, of `LEFT_OUT`; empty for any other reason."""
    return next((name for name, reason in LEFT_OUT.items() if reason in str(report.longrepr)), "")


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config: pytest.Config) -> None:
    """Say in the last lines what CI cannot test."""
    reporter = config.pluginmanager.getplugin("terminalreporter")
    counts = Counter(map(left_out, reporter.getreports("skipped"))) if reporter else Counter()
    for name, reason in LEFT_OUT.items():
        if counts[name]:
            tests = "1 test" if counts[name] == 1 else f"{counts[name]} tests"
            reporter.write_line(f"{name}: {tests} left out, since {reason}")


@pytest.fixture(scope="session")
def synthesized():
    """The app in stage dev, with every rule, drivers, relays and the settings of the whole account."""
    from tests.stacks.templates import synthesize

    return synthesize(
        device_defender=True, iot_log_level="error", drivers=True, turn=True, live_transport="pubnub"
    )


@pytest.fixture(scope="session")
def production():
    """The app with every feature of a production stage."""
    from tests.stacks.templates import synthesize

    return synthesize(
        stage="prod",
        account_concurrency=1000,
        customer_key=True,
        budget_usd=50,
        alarm_email="lab@example.org",
        tags={"team": "lab"},
        device_defender=True,
        iot_log_level="error",
        robot_metrics=True,
        drivers=True,
        turn=True,
        live_transport="pubnub",
    )
