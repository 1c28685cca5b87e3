"""`iort send`: the answer with what helps, a wheel that is taken only if asked for, a robot that is away."""

from __future__ import annotations

import io
import json
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from iort_contract.messages.control.commands import Command, decode_command
from iort_contract.messages.control.driving import DRIVEN_BY_ANOTHER, NO_LEASE
from iort_station.cli.verbs.fleet.send import commands
from iort_station.fleet.control import slept
from iort_station.page import answers


class Cloud:
    """A cloud with one robot, which answers each command with ``outcome``; None: it does not."""

    namespace = "iort"

    class exceptions:
        class ResourceNotFoundException(Exception):
            """There is no shadow."""

    def __init__(self, outcome: str | None = "accepted", *, online: bool = True) -> None:
        self.outcome, self.online = outcome, online
        self.sent: list[Command] = []

    def client(self, _service: str) -> Cloud:
        return self

    def output(self, _noun: str, name: str) -> str:
        return name

    def describe_thing(self, *, thingName: str) -> dict[str, Any]:
        return {"thingName": thingName, "ResponseMetadata": {"HTTPHeaders": {}}}

    def get_item(self, **_asked: Any) -> dict[str, Any]:
        return {"Item": {"robot": {"S": "car7"}, "online": {"BOOL": self.online}}}

    def publish(self, *, topic: str, qos: int, payload: bytes) -> None:
        assert (topic, qos) == ("cmd/iort/car7/drive", 1)
        self.sent.append(decode_command(payload))

    def get_thing_shadow(self, **_asked: Any) -> dict[str, Any]:
        said = {}
        if self.outcome is not None:
            (*_, one) = self.sent
            said = {"drive": {"session": one.session, "seq": one.seq, "outcome": self.outcome}}
        return {"payload": io.BytesIO(json.dumps({"state": {"reported": {"commands": said}}}).encode())}


def send(cloud: Cloud, *options: str) -> Any:
    asked = SimpleNamespace(cloud=lambda: cloud)
    return CliRunner().invoke(commands, ["car7", "drive", "{}", *options], obj=asked)


@pytest.mark.parametrize(("options", "takeover"), [((), False), (("--takeover",), True)])
def test_the_wheel_is_taken_only_if_that_is_asked_for(options: tuple[str, ...], takeover: bool) -> None:
    cloud = Cloud()
    assert send(cloud, *options).exit_code == 0
    asked = {
        "robot": "car7",
        "command": "drive",
        "message": "{}",
        **({"takeover": "true"} if takeover else {}),
    }
    assert slept(answers.send(cloud, asked))["accepted"]  # type: ignore[arg-type]  # a fake
    assert [command.takeover for command in cloud.sent] == [takeover, takeover]


@pytest.mark.parametrize(("outcome", "advice"), [(NO_LEASE, "--lease-ms"), (DRIVEN_BY_ANOTHER, "--takeover")])
def test_a_rejection_says_what_helps(outcome: str, advice: str) -> None:
    done = send(Cloud(f"{outcome.replace('_', ' ')}, sent 0.031 s ago, by its own clock"))
    assert advice in str(done.exception)
    assert done.exit_code == 1


def test_a_robot_that_is_away_is_told_at_once_and_hardly_waited_for() -> None:
    done = send(Cloud(None, online=False), "--seconds", "3600")
    assert "car7 is not connected" in done.stderr
    assert "car7 is not connected, and has not answered" in str(done.exception)


def test_a_robot_of_which_the_registry_does_not_know_may_still_answer() -> None:
    assert send(Cloud(online=False)).stdout == "car7 has accepted drive\n"
