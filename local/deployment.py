"""Deploys the project's stacks into the embedded cloud, with the pinned CDK command line."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from iort_contract.cloud import PUBNUB
from iort_contract.messages.envelope import rule_event
from iort_contract.messages.files import File, FileRequest, encode_file_request
from iort_contract.messages.live import LiveSample, encode_live, encode_ping
from iort_contract.tables import CONNECTED_MS, ONLINE, ROBOT, SESSION_VERSION
from iort_contract.topics import FILE, LAMBDA, LIVE, PING, build_topic
from iort_station.cloud import Cloud
from iort_station.fleet import registry
from local.emulator.package import artifact
from local.processes import LocalError, run

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
    return artifact(folder, settings, sources(root), synthesize)


def sources(root: Path) -> list[Path]:
    """The files of a checkout from which its stacks are synthesized."""
    found = [root / name for name in _MADE_OF]
    for name in _MADE_OF_FOLDERS:
        found += sorted((root / name).rglob("*.py"))
    return found


# Calls of functions at the start of an embedded cloud, before others make theirs.


def warm_up(cloud: Cloud, live: str) -> None:
    """Invoke every function for which a robot or the page waits, with an event that it takes and that has no
    effect.

    A first invocation takes seconds on a small machine, and a live message that waits for it is stale. Admit
    is not among them: it counts each call as a robot that is admitted or refused, and a claim can wait.
    """

    def event(message: bytes, lane: str, name: str) -> dict[str, Any]:
        return rule_event(message, build_topic(lane, "warm-up", name, cloud.namespace), 0)

    # A sample of 1970 is stale and is dropped.
    stale = LiveSample(boot="00000000", seq=0, t_us=0, sent_us=0, sample={}, offset_us=0)
    file = File("warm-up", "other", "text/plain", 0, hashlib.sha256(b"").hexdigest(), 0)
    events: dict[tuple[str, str], dict[str, Any]] = {
        ("processing", "Live"): event(encode_live(stale), LIVE, "warm-up"),
        ("processing", "Summarize"): {"Records": []},
        ("processing", "Echo"): event(encode_ping(0, 0), PING, LAMBDA),
        # An event without a fault and without a low voltage.
        ("processing", "Alert"): event(b"", LIVE, "warm-up"),
        # Asks for no address, so that nothing counts for a quota.
        ("processing", "Upload"): event(encode_file_request(FileRequest("00000000", file, {})), PING, FILE),
        ("fleet", "Presence"): {},
        ("processing", "Query"): {},
    }
    if live != PUBNUB:
        del events["processing", "Live"]
    client = cloud.client("lambda")
    functions = [cloud.output(stack, f"{name}Function") for stack, name in events]
    # Each starts a process, which takes a core for a second.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for _ in pool.map(partial(_invoke, client), functions, events.values()):
            pass


def end_sessions(cloud: Cloud, began_ms: int) -> None:
    """Tell the registry that sessions from before ``began_ms`` have ended: the broker that would have told so
    was killed. A robot that is back already has a later session, and stays."""
    for row in registry.listed(cloud):
        if row.get(ONLINE) and row[CONNECTED_MS] < began_ms:
            ended = {
                "clientId": row[ROBOT],
                "eventType": "disconnected",
                "timestamp": time.time_ns() // 1_000_000,
                "disconnectReason": "SERVER_ERROR",
                "versionNumber": int(row[SESSION_VERSION]),
            }
            _invoke(cloud.client("lambda"), cloud.output("fleet", "PresenceFunction"), ended)


def _invoke(client: Any, function: str, event: Mapping[str, Any]) -> None:
    answer = client.invoke(FunctionName=function, Payload=json.dumps(event).encode())
    if "FunctionError" in answer:
        reason = answer["Payload"].read().decode(errors="replace")
        raise LocalError(f"function {function} does not start: {reason[:500]}")
