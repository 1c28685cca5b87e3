"""A temporary deployment in an AWS account."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from botocore.exceptions import BotoCoreError, ClientError

from iort_contract import ROBOT
from iort_station.cloud import Cloud
from iort_station.errors import StationError
from iort_station.fleet import claims, robots
from local.deployment import ROOT
from local.errors import LocalError
from local.processes import run
from verify.errors import VerifyError

# Without CloudFront a stage takes five minutes; AWS keeps a policy for five more after its robots.
_DEPLOY_S, _DESTROY_S = 1_800.0, 1_800.0

Say = Callable[[str], None]


class Deployment:
    """The project's stacks under a namespace of their own; the CDK's logs go into ``folder``."""

    def __init__(self, cloud: Cloud, folder: Path, say: Say) -> None:
        self._cloud, self._folder, self._say = cloud, folder, say

    def deploy(self, settings: Mapping[str, str]) -> None:
        """Create the stacks, or update them to the settings. Raises `VerifyError` if the CDK fails."""
        named = "".join(f", {key}={value}" for key, value in settings.items())
        self._cdk(f"deploy{named}", _DEPLOY_S, ["deploy", "--require-approval", "never"], settings)

    def destroy(self) -> list[str]:
        """Remove robots, claims and stacks; return the leftovers, one line each."""
        left = self._without_robots()
        try:
            self._cdk("destroy", _DESTROY_S, ["destroy", "--force"], {})
        except VerifyError as error:
            left.append(str(error))
        return left

    def _without_robots(self) -> list[str]:
        left = []
        try:
            for row in list(robots.listed(self._cloud)):
                robots.remove(self._cloud, str(row[ROBOT]))
            claims.revoke_all(self._cloud)
        except (StationError, BotoCoreError, ClientError) as error:
            left.append(f"robots or claims: {error}")
        return left

    def _cdk(self, step: str, timeout_s: float, arguments: list[str], settings: Mapping[str, str]) -> None:
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        node = shutil.which("node", path=path)
        if node is None:
            raise VerifyError("the CDK command line is not installed: run `make setup`")
        context = {"namespace": self._cloud.namespace, **settings}
        self._say(step)
        try:
            run(
                f"cdk {step}",
                [
                    *[sys.executable, "scripts/destroy.py"] * (arguments[0] == "destroy"),
                    *[node, "node_modules/aws-cdk/bin/cdk", arguments[0], "--all", "--no-color"],
                    *arguments[1:],
                    *[part for key, value in context.items() for part in ("-c", f"{key}={value}")],
                ],
                environment={**os.environ, "PATH": path, "CDK_DISABLE_CLI_TELEMETRY": "true"},
                cwd=ROOT,
                log=self._folder / f"{step.split(',', maxsplit=1)[0]}-{len(settings)}.log",
                timeout_s=timeout_s,
            )
        except LocalError as error:
            raise VerifyError(str(error)) from error
