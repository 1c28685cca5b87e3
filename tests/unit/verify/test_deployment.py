"""The deployment of `make verify-aws`, and its teardown after any failure."""

from __future__ import annotations

import signal
from types import SimpleNamespace

from botocore.exceptions import ClientError
from rich.console import Console

from local.processes import LocalError
from stacks.settings import Settings
from testkit.command import wound_up
from verify.deployment import CHANGES, Deployment
from verify.preflight.deployed import STACKS


class Account:
    """A fake account with these policies; each look sees the next of these stack states."""

    namespace = "verify1"

    def __init__(self, *states, policies=()):
        self.states, self.policies, self.deleted = list(states), policies, []

    def client(self, _service):
        return self

    def describe_stacks(self, *, StackName):
        assert StackName.removeprefix("verify1-") in STACKS
        if not self.states:
            raise ClientError({"Error": {"Code": "ValidationError"}}, "DescribeStacks")
        return {"Stacks": [{"StackStatus": self.states.pop(0)}]}

    def get_paginator(self, operation):
        assert operation == "list_policies"
        page = {"policies": [{"policyName": name} for name in self.policies]}
        return SimpleNamespace(paginate=lambda: [page])

    def delete_policy(self, *, policyName):
        self.deleted.append(policyName)


class Commands:
    """A fake of the CDK's command line; it records the number of states left at each call."""

    def __init__(self, account, fails=""):
        self.account, self.fails, self.said = account, fails, []

    def __call__(self, name, command, **_how):
        self.said.append((name, command, len(self.account.states)))
        if self.fails:
            raise LocalError(self.fails)


def deployment(account, tmp_path, fails=""):
    commands = Commands(account, fails)
    return Deployment(account, tmp_path, lambda _: None, run=commands, poll_s=0.0), commands


def test_a_stack_is_deleted_only_after_cloudformation_finished_its_change(tmp_path):
    account = Account("UPDATE_IN_PROGRESS", "UPDATE_COMPLETE_CLEANUP_IN_PROGRESS")
    one, commands = deployment(account, tmp_path)
    assert one.destroy() == []
    ((name, _, states_left),) = commands.said
    assert (name, states_left) == ("cdk destroy", 0)


def test_remaining_stacks_are_reported_and_the_rest_is_removed(tmp_path):
    account = Account(policies=["verify1-verify-policy-3f", "verify1-robots", "verify12-verify-policy-3f"])
    one, _ = deployment(account, tmp_path, fails="the stack stays")
    assert one.destroy() == ["stacks: the stack stays"]
    assert account.deleted == ["verify1-verify-policy-3f"]


def test_the_second_deployment_has_everybodys_identity_and_no_page(tmp_path):
    one, commands = deployment(Account(), tmp_path)
    one.deploy(CHANGES)
    ((_, command, _),) = commands.said
    assert "--all" not in command
    assert "verify1-!(site)" in command
    given = dict(pair.split("=", 1) for pair in command if "=" in pair)
    made = Settings(**{name: given[name] for name in ("site", "live_transport", "site_robots", "drivers")})
    assert made.public
    assert made.drivers


def test_the_options_of_cdk_json_are_overridden(tmp_path):
    one, commands = deployment(Account(), tmp_path)
    one.deploy({"customer_key": "true"})
    ((_, command, _),) = commands.said
    given = dict(pair.split("=", 1) for pair in command if "=" in pair)
    assert given["stage"] == "dev"
    assert (given["site"], given["customer_key"]) == ("false", "true")


def test_an_interrupt_does_not_end_the_teardown():
    done = []
    with wound_up(Console(quiet=True)) as putting_back:
        putting_back()
        signal.raise_signal(signal.SIGINT)
        done.append("put back")
    assert done == ["put back"]
