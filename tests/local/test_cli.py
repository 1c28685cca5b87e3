"""The command `iort` against the embedded cloud."""

from __future__ import annotations

import json
import stat

import pytest


def test_robot_is_added_listed_and_removed(iort, tmp_path):
    added = iort("robots", "add", "cli-car", "--out", str(tmp_path), "--speed-to-erpm-gain", "3000")
    assert added.exit_code == 0, added.output
    key = tmp_path / "cli-car" / "private.key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert {"robot": "cli-car", "speed_to_erpm_gain": 3000.0, "speed_to_erpm_offset": 0.0} in json.loads(
        iort("robots", "list", "--json").output
    )
    assert iort("robots", "remove", "cli-car").exit_code == 0
    assert "cli-car" not in iort("robots", "list").output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("robots", "add", "car/1"), "robot name 'car/1'"),
        (("robots", "remove", "nobody"), "robot nobody is not registered"),
    ],
)
def test_error_says_what_is_wrong(iort, tmp_path, arguments, said):
    outcome = iort(*arguments)
    assert outcome.exit_code != 0
    assert said in str(outcome.exception)


def test_robot_is_not_added_twice(iort, tmp_path):
    assert iort("robots", "add", "twice", "--out", str(tmp_path / "a")).exit_code == 0
    assert "already registered" in str(iort("robots", "add", "twice", "--out", str(tmp_path / "b")).exception)
