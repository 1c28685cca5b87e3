from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.stacks.templates import Reader, Synthesized, synthesize


@pytest.fixture(scope="session")
def reader(synthesized: Synthesized) -> Reader:
    return Reader(synthesized)


@pytest.fixture(scope="session")
def alarms(synthesized: Synthesized) -> dict[str, dict[str, Any]]:
    """Every alarm by its name, without the deployment's."""
    found = synthesized.resources("AWS::CloudWatch::Alarm").values()
    return {alarm["AlarmName"].removeprefix("iort-"): alarm for alarm in found}


@pytest.fixture(scope="session")
def deployment() -> Callable[..., Synthesized]:
    """The app with these settings."""
    return synthesize
