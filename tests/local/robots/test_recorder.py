"""The event recorder from `iort recorder` to an MCAP file, with a running agent on the embedded cloud."""

from __future__ import annotations

import json
from pathlib import Path

from mcap.reader import make_reader

from iort_contract.messages.recorder import ABOUT_RECORD, UPLOADED
from iort_contract.tables import ONLINE
from iort_station.bridge.stored import McapFile
from iort_station.cli.verbs.incidents import downloaded
from iort_station.data.incidents import incidents
from iort_station.fleet import registry
from iort_station.operations import audit
from testkit.waiting import until
from tests.local.conftest import recorded
from tests.local.data.drives import Agent


def test_a_trigger_and_a_take_end_in_files_that_anybody_can_open(iort, bundle, embedded, tmp_path):
    car = bundle(sources=[{"type": "sim", "stream": "vesc", "rate_hz": 50}], recorder={})
    robot = car.robot

    def add(*options: str):
        return iort("recorder", "add", "always", "--robots", robot, "--before", "2s", "--after", "1s",
                    "--seconds", "60", *options)  # fmt: skip

    with Agent(car):
        until(lambda: registry.get(embedded.cloud, robot).get(ONLINE))
        recorded(embedded, robot, "vesc")
        assert f"{robot} has no sped in vesc" in str(add("--when", "sped > 3").exception)
        assert "no topic and no stream that matches /camera/*" in str(
            add("--on", "stop", "--topics", "/camera/*").exception
        )
        done = add(
            "--when", "voltage_input > 0", "--topics", "vesc", "--cooldown", "1h", "--budget", "5MB/day"
        )
        assert (done.exit_code, done.stdout) == (0, f"{robot}: always: accepted\n"), done.output
        (told,) = json.loads(iort("recorder", "list", robot, "--json").stdout)
        assert told["problem"] is None
        assert (told["answer"], told["trigger"]["budget_mb_day"]) == ("accepted", 5)

        until(lambda: [one for one in incidents(embedded.cloud, robot) if one.incident.state == UPLOADED])
        taken = iort("recorder", "take", robot, "--last", "5s", "--why", "a bump", "--json")
        assert taken.exit_code == 0, taken.output + str(taken.exception)
        take = json.loads(taken.stdout)["incident"]
        assert (take["trigger"], take["why"], take["state"]) == ("take", "a bump", "uploaded")

        # A note keeps what was before it, too.
        assert iort("note", robot, "a scratch", "--keep", "3s").exit_code == 0
        until(
            lambda: (
                len([one for one in incidents(embedded.cloud, robot) if one.incident.state == UPLOADED]) == 3
            )
        )
        assert iort("recorder", "remove", "always", "--robots", robot).exit_code == 0
        assert "no triggers" in iort("recorder", "list", robot).stderr

    listed = json.loads(iort("incidents", robot, "--json").stdout)
    assert sorted(one["trigger"] for one in listed) == ["always", "take", "take"]
    got = iort("incidents", "get", "--all", "--robot", robot, "--out", str(tmp_path / "incidents"))
    assert got.exit_code == 0, got.output
    for path in map(Path, got.stdout.split()):
        (one,) = [one for one in listed if one["id"] in path.name]
        with path.open("rb") as file:
            reader = make_reader(file)
            (about,) = [record.metadata for record in reader.iter_metadata() if record.name == ABOUT_RECORD]
            messages = [message for _, _, message in reader.iter_messages()]
        times = [message.publish_time // 1000 for message in messages]
        assert len(times) == one["messages"]
        # A message that came in the window was published some microseconds before.
        ring_from_us, ring_to_us = int(about["ring_from_us"]), int(about["ring_to_us"])
        assert all(
            ring_from_us <= message.log_time // 1000 <= ring_to_us or one["from_us"] <= t_us <= one["to_us"]
            for message, t_us in zip(messages, times, strict=True)
        )
        stored = (t_us for batch in audit.batches(embedded.cloud, robot, "vesc") for t_us in batch.times_us)
        assert len(times) >= sum(one["from_us"] <= t_us <= one["to_us"] for t_us in stored) > 0, one
        played = McapFile(downloaded(embedded.cloud, one["id"], tmp_path / one["id"]))
        every = frozenset(range(len(played.topics)))
        messages = played.messages(played.start_ns, every, lambda: None, lambda _text: None)
        assert len(list(messages)) == one["messages"], "what `iort bridge --incident` plays"
