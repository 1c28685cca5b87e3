"""Deploys the project's stacks into the embedded cloud, with the pinned CDK command line."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from iort_contract.cloud import PUBNUB
from iort_station.cloud import Cloud
from local.errors import LocalError
from local.made_once import kept
from local.processes import run

ROOT = Path(__file__).resolve().parent.parent
_ACCOUNT = "000000000000"
_STEP_S = 600.0
# The sources of a synthesized assembly. If they have not changed, the kept assembly is deployed.
_MADE_OF = ("app.py", "cdk.json", "requirements/dev.txt", "requirements/layer.txt", "scripts/layer.py")
_MADE_OF_FOLDERS = ("stacks", "functions", "contract/iort_contract", "analysis/iort_analysis")


def deploy(
    cloud: Cloud, folder: Path, progress: Callable[[str], None], *, live: str = PUBNUB, kept: bool = False
) -> None:
    """Bootstrap and deploy every stack, with the way ``live`` to the page; logs go into ``folder``. What a
    ``kept`` cloud has already is not deployed again.

    Raises `LocalError` if that fails.
    """
    cdk = CommandLine(cloud, folder, progress)
    settings = {
        "embedded": "true",
        "namespace": cloud.namespace,
        "layer": "build/layer/local",
        "live_transport": live,
        # They are on loopback, as the page that drives is, and the identity of a page for everybody.
        "drivers": "true",
        "site_robots": "*",
    }
    context = [f"{key}={value}" for key, value in settings.items()]

    def synthesize(output: Path) -> None:
        app = f"{shlex.quote(sys.executable)} app.py"
        given = [part for one in context for part in ("-c", one)]
        cdk.run("synth", "--app", app, "--output", str(output), "--quiet", *given)

    stacks = assembly(ROOT, ROOT / "build" / "assembly", settings=" ".join(context), synthesize=synthesize)
    if kept and _deployed(cloud) == stacks.name:
        return
    cdk.put(stacks, account=_ACCOUNT)
    if kept:
        name = _marker(cloud.namespace)
        cloud.client("ssm").put_parameter(Name=name, Value=stacks.name, Type="String", Overwrite=True)


def _deployed(cloud: Cloud) -> str | None:
    """The assembly that a kept cloud has; it is told in the cloud itself, so that a restored backup has its
    own."""
    ssm = cloud.client("ssm")
    try:
        return str(ssm.get_parameter(Name=_marker(cloud.namespace))["Parameter"]["Value"])
    except ssm.exceptions.ParameterNotFound:
        return None


def _marker(namespace: str) -> str:
    return f"/{namespace}/assembly"


class CommandLine:
    """The pinned CDK command line for an emulator; its output goes into logs in ``folder``."""

    def __init__(self, cloud: Cloud, folder: Path, progress: Callable[[str], None]) -> None:
        self._folder, self._progress, self._region = folder, progress, cloud.region or ""
        cdk = ROOT / "node_modules" / "aws-cdk" / "bin" / "cdk"
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', os.defpath)}"
        node = shutil.which("node", path=path)
        if node is None or not cdk.exists():
            raise LocalError("the CDK command line is not installed: run `make setup`")
        self._command = (node, str(cdk))
        self._environment = {
            "PATH": path,
            "HOME": str(folder),
            "AWS_ENDPOINT_URL": cloud.endpoint_url or "",
            "AWS_CA_BUNDLE": cloud.ca_bundle or "",
            "NODE_EXTRA_CA_CERTS": cloud.ca_bundle or "",
            "AWS_ACCESS_KEY_ID": cloud.access_key_id or "",
            "AWS_SECRET_ACCESS_KEY": cloud.secret_access_key or "",
            "AWS_REGION": self._region,
            "AWS_EC2_METADATA_DISABLED": "true",
            "CDK_DISABLE_VERSION_CHECK": "1",
            # AWS' rules for templates, most of a synthesis. `make deploy` and `make check` use them.
            "CDK_VALIDATION": "false",
            "CDK_DISABLE_CLI_TELEMETRY": "true",
            "JSII_RUNTIME_PACKAGE_CACHE_ROOT": str(ROOT / "build" / "jsii-cache"),
        }

    def put(self, assembly: Path, *, account: str) -> None:
        """Bootstrap the account and deploy every stack of an assembly."""
        self.run("bootstrap", f"aws://{account}/{self._region}", "--app", str(assembly))
        self.run(
            *("deploy", "--all", "--app", str(assembly)),
            *("--require-approval", "never", "--method", "direct"),
        )

    def run(self, verb: str, *arguments: str) -> None:
        """Run one verb to its end; raises `LocalError` if it fails."""
        self._progress(f"cdk {verb}")
        run(
            f"cdk {verb}",
            [*self._command, verb, *arguments, "--no-color"],
            environment=self._environment,
            cwd=ROOT,
            log=self._folder / f"cdk-{verb}.log",
            timeout_s=_STEP_S,
        )


def assembly(root: Path, folder: Path, *, settings: str, synthesize: Callable[[Path], None]) -> Path:
    """The synthesized stacks of the checkout with these settings: kept ones, or new ones from
    ``synthesize``."""
    return kept(folder, settings, sources(root), synthesize)


def sources(root: Path) -> list[Path]:
    """The files of a checkout from which its stacks are synthesized."""
    found = [root / name for name in _MADE_OF]
    for name in _MADE_OF_FOLDERS:
        found += sorted((root / name).rglob("*.py"))
    return found
