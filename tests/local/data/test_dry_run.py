"""A dry-run over what a robot has recorded finds the windows that the robot's own recorder has kept."""

from __future__ import annotations

import json

from iort_contract.tables import ONLINE
from iort_station.data.incidents import incidents
from iort_station.fleet import registry
from testkit.waiting import until
from tests.local.conftest import recorded
from tests.local.data.drives import Agent, counter_log


def test_a_robot_keeps_the_windows_that_a_dry_run_finds(embedded, bundle, iort, tmp_path):
    """The counter passes another fifty every two seconds."""
    log = counter_log(tmp_path / "ride.csv", seconds=120)
    car = bundle(sources=[{"type": "bag", "path": str(log)}], recorder={})
    robot = car.robot

    def kept():
        found = (one.incident for one in incidents(embedded.cloud, robot))
        return sorted((one.from_us, one.to_us) for one in found)

    with Agent(car):
        until(lambda: registry.get(embedded.cloud, robot).get(ONLINE))
        recorded(embedded, robot, "vesc")
        window = ("--before", "300ms", "--after", "200ms", "--cooldown", "1s", "--seconds", "60")
        added = iort("recorder", "add", "fifty", "--robots", robot, "--when", "speed % 100 >= 50", *window)
        assert added.exit_code == 0, added.output
        until(lambda: len(kept()) >= 4)
    done = iort("recorder", "dry-run", "fifty", "--robots", robot, "--last", "1h", "--json")
    assert done.exit_code == 0, done.output
    (told,) = json.loads(done.stdout)
    found = [(window["from_us"], window["to_us"]) for window in told["windows"]]
    # Before it had the trigger, it kept nothing; and what was open at its end, the next run would have kept.
    assert [window for window in found if window >= kept()[0]][: len(kept())] == kept()
    assert all(edge["values"]["speed"] % 100 == 50 for edge in told["edges"])
