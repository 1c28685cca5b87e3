"""Functions read their environment as the stacks write it."""

from __future__ import annotations

import pytest

from iort_contract.catalog.environments import (
    AlertEnvironment,
    LaterEnvironment,
    LiveEnvironment,
    UploadEnvironment,
)


@pytest.mark.parametrize(
    "written",
    [
        LiveEnvironment("iort", "/iort/pubnub", {"vesc": ["speed"], "imu": []}, "queue"),
        LaterEnvironment("iort", "archive", "telemetry", "summary", "robots", "queue", robot_metrics=True),
        LaterEnvironment("iort", "archive", "telemetry", "summary", "robots", "queue", robot_metrics=False),
        AlertEnvironment("iort", "robots", "topic", 10.5),
        UploadEnvironment("iort", "files", "robots", "queue", 50 * 10**9),
    ],
)
def test_an_environment_is_read_as_it_was_written(written):
    variables = written.variables()
    assert all(isinstance(text, str) and name.isupper() for name, text in variables.items())
    assert type(written).read({**variables, "PATH": "/bin"}) == written


def test_a_missing_variable_is_named():
    with pytest.raises(KeyError, match="ALARM_TOPIC"):
        AlertEnvironment.read({"NAMESPACE": "iort", "ROBOTS_TABLE": "robots"})
