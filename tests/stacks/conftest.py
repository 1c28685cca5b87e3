from __future__ import annotations

from typing import Any

import pytest

from tests.conftest import Synthesized
from tests.stacks.templates import Reader


@pytest.fixture(scope="session")
def reader(synthesized: Synthesized) -> Reader:
    return Reader(synthesized)


@pytest.fixture(scope="session")
def alarms(synthesized: Synthesized) -> dict[str, dict[str, Any]]:
    """Every alarm by its name, without the deployment's."""
    found = synthesized.resources("AWS::CloudWatch::Alarm").values()
    return {alarm["AlarmName"].removeprefix("iort-"): alarm for alarm in found}
