"""A temporary deployment in an AWS account."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract.cloud import PUBNUB
from iort_contract.tables import ROBOT
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import files, identity, robots
from local.deployment import ROOT
from local.processes import LocalError, run
from stacks.settings import DEV
from testkit.waiting import InstrumentError, until
from verify.preflight.deployed import STACKS, stack
from verify.preflight.finding import listed
from verify.questions.identity import POLICY

# Without CloudFront a stage takes five minutes; AWS keeps a policy for five more after its robots.
_DEPLOY_S, _DESTROY_S = 1_800.0, 1_800.0
# cdk.json may say otherwise for the operator's own deployment: what must go again keeps nothing.
_OF_ITS_OWN = {
    "stage": DEV,
    # Lambda 1 is asked about, too. Whoever listens at AWS IoT hears the same cars.
    "live_transport": PUBNUB,
    "site": "false",
    "customer_key": "false",
    "keep_customer_key": "false",
    "device_defender": "false",
    "iot_log_level": "off",
    "budget_usd": "0",
    "drivers": "true",
    "turn": "false",
}
# The second deployment: a key of the account's own, relays, and everybody's identity, which the page on the
# web has.
CHANGES = {
    "customer_key": "true",
    "turn": "true",
    "site": "true",
    "live_transport": "iot",
    "site_robots": "verify-public",
}
# The page itself is left out: a new account has to wait for its first CloudFront distribution.
_ALL_BUT_THE_PAGE = "!(site)"

Say = Callable[[str], None]


class Deployment:
    """The project's stacks under a namespace of their own; the CDK's logs go into ``folder``."""

    def __init__(
        self, cloud: Cloud, folder: Path, say: Say, *, run: Callable[..., None] = run, poll_s: float = 10.0
    ) -> None:
        self._cloud, self._folder, self._say = cloud, folder, say
        self._run, self._poll_s = run, poll_s

    def deploy(self, settings: Mapping[str, str]) -> None:
        """Create the stacks, or update them to the settings. Raises `InstrumentError` if the CDK fails."""
        named = "".join(f", {key}={value}" for key, value in settings.items())
        self._cdk(f"deploy{named}", _DEPLOY_S, ["deploy", "--require-approval", "never"], settings)

    def destroy(self) -> list[str]:
        """Remove what the questions made, and the stacks; what stayed is returned, a line each."""
        left = []
        for what, step in (
            ("stacks", self._wait),
            ("robots", self._remove_robots),
            ("claims", self._revoke_claims),
            ("files", self._delete_files),
            ("stacks", lambda: self._cdk("destroy", _DESTROY_S, ["destroy", "--force"], {})),
            ("policies", self._delete_policies),
        ):
            try:
                step()
            except (StationError, InstrumentError, BotoCoreError, ClientError) as error:  # noqa: PERF203 - all are tried
                left.append(f"{what}: {error}")
        return left

    def _wait(self) -> None:
        """CloudFormation goes on after the CDK was ended, and deletes no stack that it is changing."""

        def changing(noun: str) -> bool:
            status = str((self._stack(noun) or {}).get("StackStatus", ""))
            # A change set that was never executed: such a stack is empty.
            return status.endswith("IN_PROGRESS") and status != "REVIEW_IN_PROGRESS"

        what, most = "the end of CloudFormation's work", _DEPLOY_S
        until(lambda: not any(map(changing, STACKS)), what, within_s=most, poll_s=self._poll_s)

    def _stack(self, noun: str) -> Mapping[str, Any] | None:
        return stack(self._cloud, f"{self._cloud.namespace}-{noun}")

    def _remove_robots(self) -> None:
        if self._stack("storage") is None:
            return
        left = []
        for row in list(robots.listed(self._cloud)):
            try:
                robots.remove(self._cloud, str(row[ROBOT]))
            except (StationError, BotoCoreError, ClientError) as error:  # noqa: PERF203 - the next one may go
                left.append(f"{row[ROBOT]}: {error}")
        if left:
            raise InstrumentError("; ".join(left))

    def _revoke_claims(self) -> None:
        if self._stack("fleet") is not None:
            identity.revoke_claims(self._cloud)

    def _delete_files(self) -> None:
        """CloudFormation deletes no bucket that holds something."""
        if self._stack("storage") is not None:
            files.empty(self._cloud)

    def _delete_policies(self) -> None:
        """Delete the policies of a question that was interrupted while AWS kept its policy."""
        iot = self._cloud.client("iot")
        for name in [one["policyName"] for one in listed(iot, "list_policies", "policies")]:
            if name.startswith(f"{self._cloud.namespace}-{POLICY}"):
                iot.delete_policy(policyName=name)

    def _cdk(self, step: str, timeout_s: float, arguments: list[str], settings: Mapping[str, str]) -> None:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        node = shutil.which("node", path=path)
        if node is None:
            raise InstrumentError("the CDK command line is not installed: run `make setup`")
        context = {"namespace": self._cloud.namespace, **_OF_ITS_OWN, **settings}
        self._say(step)
        try:
            self._run(
                f"cdk {step}",
                [
                    *[sys.executable, "scripts/destroy.py"] * (arguments[0] == "destroy"),
                    *[node, "node_modules/aws-cdk/bin/cdk", arguments[0], "--no-color"],
                    f"{self._cloud.namespace}-{_ALL_BUT_THE_PAGE}",
                    *arguments[1:],
                    *[part for key, value in context.items() for part in ("-c", f"{key}={value}")],
                ],
                environment={**os.environ, "PATH": path, "CDK_DISABLE_CLI_TELEMETRY": "true"},
                cwd=ROOT,
                log=self._folder / f"{step.split(',', maxsplit=1)[0]}-{len(settings)}.log",
                timeout_s=timeout_s,
            )
        except LocalError as error:
            raise InstrumentError(str(error)) from error
